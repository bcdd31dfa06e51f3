"""A closed office of 9 x 7 x 2.8 metres with furniture, people, a radiator under a window, screens and lamps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.builder import SceneBuilder
from thegra_core.simulation.materials import (
    ALUMINIUM,
    CARPET,
    CEILING,
    GLASS,
    HOT,
    PAPER,
    PLASTER,
    PLASTIC,
    ROOM_K,
    STEEL,
    WOOD,
    chair,
    person,
    radiator,
    shelf,
    table,
)
from thegra_core.simulation.routes import Route
from thegra_core.simulation.scene import Scene, Sky, Surface

FloatArray = NDArray[np.float64]

SIZE = (9.0, 7.0, 2.8)
_LAP = 0.003  # walls reach this far past each other, so that no ray slips through where they meet
_STRATA_K = 0.9  # the air is warmer under the ceiling


def room(seed: int = 0) -> Scene:
    """The room; the middle of the floor, an ellipse of 2.6 x 1.7 m half axes, is free to walk."""
    b = SceneBuilder("room", seed)
    _shell(b)
    _window_wall(b)
    _furniture(b)
    _on_the_walls(b)
    return b.scene(Sky(ROOM_K, ROOM_K), ambient_k=ROOM_K)


def _shell(b: SceneBuilder) -> None:
    x, y, z = SIZE
    e = _LAP
    b.quad([-e, -e, 0], [x + 2 * e, 0, 0], [0, y + 2 * e, 0], CARPET)
    b.quad([-e, -e, z], [x + 2 * e, 0, 0], [0, y + 2 * e, 0], CEILING)
    strata = (-_STRATA_K / 2, -_STRATA_K / 2, _STRATA_K / 2, _STRATA_K / 2)
    for corner, along in (([-e, 0, -e], [x + 2 * e, 0, 0]), ([-e, y, -e], [x + 2 * e, 0, 0]), ([0, -e, -e], [0, y + 2 * e, 0]), ([x, -e, -e], [0, y + 2 * e, 0])):
        b.quad(corner, along, [0, 0, z + 2 * e], replace(PLASTER, kelvin=PLASTER.kelvin + b.rng.uniform(-0.4, 0.4)), strata)
    for side in (0.01, y - 0.01):
        b.box((x / 2, side, 0), (x, 0.02, 0.09), replace(WOOD, kelvin=ROOM_K - 0.9))
    for fx in (0.2, 0.5, 0.8):
        for fy in (0.25, 0.75):
            b.box((fx * x, fy * y, z - 0.05), (1.2, 0.3, 0.05), replace(PLASTIC, kelvin=ROOM_K + 5), yaw=0.0, spread_k=0.3)
            b.cylinder((fx * x - 0.5, fy * y, z - 0.07), (fx * x + 0.5, fy * y, z - 0.07), 0.02, HOT, ring=10)


def _window_wall(b: SceneBuilder) -> None:
    """At x = SIZE[0]: two cold windows in frames, a radiator under each, a curtain."""
    x, y, _ = SIZE
    for middle in (0.3 * y, 0.72 * y):
        b.box((x - 0.02, middle, 0.95), (0.04, 1.9, 1.35), replace(WOOD, kelvin=ROOM_K - 2.2), spread_k=0.3)
        for side in (-0.46, 0.46):
            b.box((x - 0.045, middle + side, 1.02), (0.02, 0.82, 1.2), GLASS, spread_k=0.2)
        b.box((x - 0.1, middle, 0.9), (0.2, 2.0, 0.03), PLASTIC)
        radiator(b, (x - 0.12, middle, 0.05), np.pi / 2, 1.3)
        for side in (-1.1, 1.1):
            for fold in range(5):
                b.cylinder((x - 0.1, middle + side + 0.05 * fold - 0.1, 0.4), (x - 0.1, middle + side + 0.05 * fold - 0.1, 2.4), 0.03, replace(PAPER, kelvin=ROOM_K - 0.6 + 0.25 * (fold % 2)), ring=10)


def _furniture(b: SceneBuilder) -> None:
    y = SIZE[1]
    for position in (1.0, 2.1, 3.2, 4.3):
        shelf(b, (position, 0.22, 0), 0.0, 1.0, float(b.rng.uniform(1.5, 2.1)))
    shelf(b, (0.22, 2.2, 0), -np.pi / 2, 1.2, 1.6)
    for place, yaw in (((6.4, 0.55, 0), 0.0), ((2.2, y - 0.6, 0), np.pi), ((5.2, y - 0.6, 0), np.pi)):
        _desk(b, np.array(place, dtype=float), yaw)
    table(b, (0.75, 4.6, 0), (0.8, 1.4), 0.0)
    for _ in range(7):
        size = b.rng.uniform([0.06, 0.06, 0.04], [0.25, 0.3, 0.3])
        b.box((b.rng.uniform(0.5, 1.0), b.rng.uniform(4.1, 5.1), 0.74), size, replace(PAPER, kelvin=ROOM_K + b.rng.uniform(-0.6, 1.2)), b.rng.uniform(0, 3))
    b.cylinder((0.7, 4.3, 0.74), (0.7, 4.3, 0.86), 0.04, HOT, ring=16)  # a cup of tea
    person(b, (8.0, 3.5, 0), np.pi / 2)
    person(b, (0.65, 6.1, 0), -2.2)
    chair(b, (7.7, 1.5, 0), 0.6, warm_k=1.5)
    b.cylinder((8.5, 0.5, 0), (8.5, 0.5, 0.35), 0.18, replace(PLASTIC, kelvin=ROOM_K - 1), ring=24)  # a plant in its pot
    for _ in range(6):
        offset = b.rng.uniform([-0.2, -0.2, 0.6], [0.2, 0.2, 1.2])
        b.ellipsoid(np.array([8.5, 0.5, 0]) + offset, b.rng.uniform(0.12, 0.25, 3), replace(WOOD, kelvin=ROOM_K - 1.2, noise_k=0.3, noise_m=0.15), rough_m=0.06)


def _desk(b: SceneBuilder, place: FloatArray, yaw: float) -> None:
    """A desk with a person or an empty chair, screen, computer, keyboard, papers."""
    c, s = np.cos(yaw), np.sin(yaw)

    def at(u: float, v: float, up: float) -> FloatArray:
        return np.asarray(place + [c * u - s * v, s * u + c * v, up])

    table(b, place, (1.6, 0.8), yaw)
    screen = Surface(ROOM_K + 6.5, 0.94, noise_k=0.4, noise_m=0.3, octaves=3)
    b.box(at(-0.2, -0.2, 0.85), (0.6, 0.04, 0.36), screen, yaw, spread_k=0.8)
    b.box(at(-0.2, -0.2, 0.74), (0.06, 0.06, 0.15), PLASTIC, yaw)
    b.box(at(-0.2, 0.12, 0.74), (0.42, 0.14, 0.02), replace(PLASTIC, kelvin=ROOM_K + 0.9, spots_k=0.5, spots_m=0.05), yaw)
    b.box(at(0.6, 0.0, 0.0), (0.2, 0.5, 0.45), replace(STEEL, kelvin=ROOM_K + 3.0, noise_k=0.5), yaw, spread_k=0.8)
    b.cylinder(at(0.65, -0.25, 0.74), at(0.55, -0.1, 1.2), 0.015, STEEL, ring=8)
    b.ellipsoid(at(0.52, -0.05, 1.2), (0.09, 0.09, 0.06), replace(HOT, kelvin=ROOM_K + 20))
    for _ in range(4):
        b.box(at(b.rng.uniform(-0.75, 0.7), b.rng.uniform(-0.1, 0.3), 0.74), b.rng.uniform([0.08, 0.1, 0.01], [0.25, 0.3, 0.12]), replace(PAPER, kelvin=ROOM_K + b.rng.uniform(-0.4, 0.6)), yaw + b.rng.uniform(-0.4, 0.4))
    chair(b, at(-0.15, 0.7, 0), yaw + np.pi, warm_k=0.8)
    if b.rng.random() < 0.6:
        person(b, at(-0.15, 0.68, 0), yaw + np.pi, seated=True)


def _on_the_walls(b: SceneBuilder) -> None:
    """Pictures, sockets, a door, pipes, a clock, a steel whiteboard that reflects."""
    x, y, z = SIZE
    for position in (5.1, 7.9):
        b.box((position, 0.015, 1.4), (b.rng.uniform(0.4, 0.7), 0.03, b.rng.uniform(0.4, 0.8)), PAPER, spread_k=0.4)
    for position in (0.8, 3.6, 6.6):
        b.box((position, y - 0.015, 1.35), (b.rng.uniform(0.4, 0.9), 0.03, b.rng.uniform(0.4, 0.8)), replace(PAPER, spots_k=0.5), spread_k=0.5)
    b.box((7.9, y - 0.025, 0), (0.95, 0.05, 2.05), replace(WOOD, kelvin=ROOM_K - 0.9), spread_k=0.2)
    b.box((7.9, y - 0.04, 0), (0.8, 0.05, 2.0), replace(WOOD, kelvin=ROOM_K - 0.5), spread_k=0.2)
    b.ellipsoid((7.58, y - 0.1, 1.02), (0.06, 0.03, 0.02), STEEL)
    b.box((0.015, 4.7, 1.1), (0.03, 1.5, 1.0), replace(ALUMINIUM, emissivity=0.3), spread_k=0.05)
    for height in (0.12, 0.22):
        b.cylinder((0.0, y - 0.06, height), (x, y - 0.06, height), 0.014, replace(HOT, kelvin=ROOM_K + 6 + 20 * (height - 0.12)), ring=10)
    b.cylinder((0.07, 3.4, 0), (0.07, 3.4, z), 0.03, replace(HOT, kelvin=ROOM_K + 4), ring=12)
    for _ in range(16):
        wall = b.rng.integers(4)
        along, up = b.rng.uniform(0.4, 0.6 * (x if wall < 2 else y)) + 0.2, b.rng.choice([0.3, 1.1, 2.3])
        place, size = [((along, 0.01, up), (0.09, 0.02, 0.09)), ((along, y - 0.01, up), (0.09, 0.02, 0.09)), ((0.01, along, up), (0.02, 0.09, 0.09)), ((x - 0.01, along, up), (0.02, 0.09, 0.09))][wall]
        b.box(place, size, replace(PLASTIC, kelvin=ROOM_K + b.rng.choice([-0.6, 0.5, 1.2, 3.0])))


def room_route() -> Route:
    """Round the free middle of the room, looking across it."""
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    x, y, _ = SIZE
    height = 1.45 + 0.12 * np.sin(3 * angles)
    points = np.c_[x / 2 + 2.0 * np.cos(angles), y / 2 + 1.15 * np.sin(angles), height]
    return Route(points, speed_m_s=0.5, gaze="across", room_m=0.6, target=(x / 2, y / 2, 1.25))
