"""All parameters of a node: declared when it starts, read when it is configured, closed to changes until it is cleaned up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from thegra_core.config import ThegraConfig
from thegra_core.errors import ConfigError
from thegra_ros.node_config import NodeConfig
from thegra_ros.parameters import declare, declared, from_ros, load_defaults, validated

AT_ANY_TIME = frozenset({"map_file"})
"""Parameters that may change while the node is configured: they are read when they are needed."""


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

    @property
    def map_file(self) -> Path:
        """What `map_file` says now.

        Raises:
            ConfigError: If it says nothing.
        """
        named = str(self._own["map_file"])
        if not named:
            raise ConfigError("no file is named: set the parameter map_file first")
        return Path(named).expanduser().absolute()

    def _on_set(self, changes: Sequence[Parameter]) -> SetParametersResult:
        """Refuse what the model refuses, and most changes while the node is configured; names of others (use_sim_time, qos_overrides) pass."""
        method, own = dict(self._method), dict(self._own)
        concerned: set[str] = set()
        for change in changes:
            for values in (method, own):
                if change.name in values:
                    values[change.name] = change.value
                    concerned.add(change.name)
        if not concerned:
            return SetParametersResult(successful=True)
        if self.configured and not concerned <= AT_ANY_TIME:
            return SetParametersResult(successful=False, reason="takes effect when the node is configured: deactivate and clean it up first, or restart it")
        try:
            self._validated(method, own)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._method, self._own = method, own
        return SetParametersResult(successful=True)

    def _validated(self, method: dict[str, Any], own: dict[str, Any]) -> tuple[ThegraConfig, NodeConfig]:
        return from_ros(method, self._defaults), validated(NodeConfig, own)


def begin_in(own: NodeConfig) -> Path | None:
    """The file with the map in which to begin; None: in an empty map.

    Raises:
        ConfigError: If localisation is all that is wanted, and there is no such file.
    """
    path = Path(own.map_file).expanduser().absolute() if own.map_file else None
    if path is not None and path.is_file():
        return path
    if own.localization_only:
        raise ConfigError(f"localization_only needs a map, and {path or 'map_file, which names it,'} is not there")
    return None
