"""Monocular SLAM for thermal cameras, as a library without ROS."""

from thegra_core.version import VERSION

__version__ = VERSION
