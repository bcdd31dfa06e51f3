"""Monocular SLAM for thermal cameras, as a library without ROS."""

from thegra_core.version import VERSION as __version__

__all__ = ["__version__"]
