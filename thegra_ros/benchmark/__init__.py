"""What ROS costs, and whether a node can run for long."""
