"""All parameters of a node: declared when it starts, read when it is configured, closed to changes until it is cleaned up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from thegra_core.config import ThegraConfig
from thegra_core.errors import ConfigError
from thegra_ros.node_config import NodeConfig
from thegra_ros.parameters import declare, declared, from_ros, load_defaults, validated


class NodeParameters:
    """The method's configuration and the node's own.

    Raises:
        ConfigError: If what was given when the node started is not understood.
    """

    def __init__(self, node: Node) -> None:
        self.configured = False
        self._defaults = load_defaults(node)
        self._method = declare(node, declared(self._defaults))
        self._own = declare(node, declared(NodeConfig()))
        self._validated(self._method, self._own)
        node.add_on_set_parameters_callback(self._on_set)

    def read(self) -> tuple[ThegraConfig, NodeConfig]:
        """What the parameters say now."""
        return self._validated(self._method, self._own)

    def _on_set(self, changes: Sequence[Parameter]) -> SetParametersResult:
        """Refuse what the model refuses, and changes while the node is configured; names of others (use_sim_time, qos_overrides) pass."""
        method, own = dict(self._method), dict(self._own)
        concerned = False
        for change in changes:
            for values in (method, own):
                if change.name in values:
                    values[change.name] = change.value
                    concerned = True
        if not concerned:
            return SetParametersResult(successful=True)
        if self.configured:
            return SetParametersResult(successful=False, reason="takes effect when the node is configured: deactivate and clean it up first, or restart it")
        try:
            self._validated(method, own)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._method, self._own = method, own
        return SetParametersResult(successful=True)

    def _validated(self, method: dict[str, Any], own: dict[str, Any]) -> tuple[ThegraConfig, NodeConfig]:
        return from_ros(method, self._defaults), validated(NodeConfig, own)
