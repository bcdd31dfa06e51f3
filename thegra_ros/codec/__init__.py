"""Thegra's messages as standard ROS messages and back: no number is rounded on the way."""
