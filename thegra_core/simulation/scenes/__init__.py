"""The scenes by name, with the route through each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from thegra_core.simulation.routes import Route
from thegra_core.simulation.scene import Scene
from thegra_core.simulation.scenes.corridor import corridor, corridor_route
from thegra_core.simulation.scenes.room import room, room_route
from thegra_core.simulation.scenes.street import street, street_route
from thegra_core.simulation.scenes.tunnel import tunnel, tunnel_route

SceneName = Literal["room", "corridor", "street", "tunnel"]


@dataclass(frozen=True, slots=True)
class SceneKind:
    """How to make a scene from a seed, and the closed route through it."""

    make: Callable[[int], Scene]
    route: Callable[[], Route]
    outdoors: bool = False


SCENES: dict[SceneName, SceneKind] = {
    "room": SceneKind(room, room_route),
    "corridor": SceneKind(corridor, corridor_route),
    "street": SceneKind(street, street_route, outdoors=True),
    "tunnel": SceneKind(tunnel, tunnel_route),
}
