"""Quality of service: profiles of the topics, overriding by parameters, and what is said when two ends do not fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions

SENSOR = qos_profile_sensor_data
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STREAM = QoSProfile(depth=4, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST)
LOSSLESS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST)
"""Between stages: a lost message would make tracking's replica differ from the map."""
TF = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST)
TF_STATIC = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def publisher_options(node: Node, topic: str) -> dict[str, Any]:
    """Options of a publisher: its quality of service can be overridden (`qos_overrides./TOPIC.publisher.POLICY`), and misfits are logged."""
    return {
        "qos_overriding_options": QoSOverridingOptions.with_default_policies(),
        "event_callbacks": PublisherEventCallbacks(incompatible_qos=_teller(node, topic, "a subscriber asks for more than this node offers", "publisher")),
    }


def subscription_options(node: Node, topic: str) -> dict[str, Any]:
    """The same for a subscription."""
    return {
        "qos_overriding_options": QoSOverridingOptions.with_default_policies(),
        "event_callbacks": SubscriptionEventCallbacks(incompatible_qos=_teller(node, topic, "a publisher offers less than this node asks for", "subscription")),
    }


def _teller(node: Node, topic: str, what: str, role: str) -> Callable[[Any], None]:
    def tell(event: Any) -> None:
        name = node.resolve_topic_name(topic)
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        node.get_logger().warning(
            f"no data between this node and one other on {name}: {what} ({policy}); set the parameter qos_overrides.{name}.{role}.{policy}, or the other node's"
        )

    return tell
