"""Prints what Thegra publishes: python examples/listen.py --ros-args -r __ns:=/thegra"""

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

rclpy.init()
node = Node("listener")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # the last one, also for who comes late


def on_pose(message: PoseWithCovarianceStamped) -> None:
    at, spread = message.pose.pose.position, message.pose.covariance[0] ** 0.5
    print(f"pose in {message.header.frame_id}: x {at.x:.2f} y {at.y:.2f} z {at.z:.2f}, x +-{spread:.3f}", flush=True)


node.create_subscription(PoseWithCovarianceStamped, "pose", on_pose, 10)
node.create_subscription(Path, "path", lambda path: print(f"path of {len(path.poses)} poses", flush=True), latched)
node.create_subscription(PointCloud2, "map_points", lambda cloud: print(f"map of {cloud.width} points", flush=True), latched)
rclpy.spin(node)
