"""Where in the graph the topics are that a node waits for in vain."""

from __future__ import annotations

from rclpy.node import Node

OUTPUTS = ("image_preprocessed", "image_tracks")
"""Images that Thegra itself publishes."""


def advice(node: Node, kind: type, topic: str, remap: str) -> str:
    """What the graph tells of a topic that brings nothing: who publishes that kind of message, and what to do.

    Args:
        kind: The message.
        topic: Its topic, resolved.
        remap: What to type to take another topic.
    """
    if node.count_publishers(topic):
        return f"something publishes {topic}, but nothing has come"
    wanted = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
    there = (name for name, kinds in node.get_topic_names_and_types() if wanted in kinds and name.rpartition("/")[2] not in OUTPUTS)
    others = sorted(name for name in there if node.count_publishers(name))
    if others:
        return f"nobody publishes {topic}; {kind.__name__} is on {', '.join(others)}: {remap}"
    return f"nobody publishes {topic}, nor {kind.__name__} on any other topic: is the driver running, with the same ROS_DOMAIN_ID?"
