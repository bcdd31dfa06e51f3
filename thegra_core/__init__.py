"""Monocular SLAM for thermal cameras, as a library without ROS."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("thegra_ros")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "unknown"
