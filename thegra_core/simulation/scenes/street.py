"""Streets round a block of houses on a clear evening: facades with windows, cars, trees, lamps, people, and a cold sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.builder import SceneBuilder
from thegra_core.simulation.materials import GLASS, HOT, STEEL, person
from thegra_core.simulation.routes import Route, rounded_rectangle
from thegra_core.simulation.scene import Scene, Sky, Surface
from thegra_core.simulation.scenes.walls import Wall, around
from thegra_core.simulation.texture import BRICKS, TILES

FloatArray = NDArray[np.float64]

BLOCK = (20.0, 13.0)
STREET = 10.0
AIR_K = 283.0
_PAVEMENT = 2.0
_ASPHALT = Surface(AIR_K + 3.0, 0.95, noise_k=0.5, noise_m=3.0, octaves=6, spots_k=1.5, spots_m=1.6, spots_share=0.6)
_SLABS = Surface(AIR_K + 1.0, 0.93, noise_k=0.35, noise_m=1.0, octaves=4, spots_k=0.4, spots_m=0.7, spots_share=0.4, pattern=TILES, period_u=0.5, period_v=0.5, line_m=0.012, line_k=-0.3, cell_k=0.2)
_BRICK = Surface(AIR_K + 1.0, 0.93, noise_k=0.25, noise_m=1.6, octaves=5, spots_k=1.3, spots_m=0.9, spots_share=0.45, pattern=BRICKS, period_u=0.25, period_v=0.083, line_m=0.012, line_k=-0.3, cell_k=0.5)
_RENDER = Surface(AIR_K + 1.5, 0.92, noise_k=0.55, noise_m=2.0, octaves=6, spots_k=1.3, spots_m=1.1, spots_share=0.5)
_PANE = replace(GLASS, kelvin=AIR_K + 2.0, noise_k=0.4)
_FRAME = Surface(AIR_K + 2.6, 0.93, noise_k=0.2, noise_m=0.5)
_LACQUER = Surface(AIR_K - 1.5, 0.88, noise_k=0.2, noise_m=0.6, octaves=3, spots_k=0.3, spots_m=0.4, spots_share=0.3)
_RUBBER = Surface(AIR_K + 0.5, 0.95, noise_k=0.2, noise_m=0.2)
_BARK = Surface(AIR_K + 0.3, 0.95, noise_k=0.3, noise_m=0.4, octaves=4)
_LEAVES = Surface(AIR_K - 0.2, 0.97, noise_k=0.5, noise_m=0.6, octaves=5, spots_k=0.6, spots_m=0.3, spots_share=0.6)


def street(seed: int = 0) -> Scene:
    """The block and the houses across its four streets; the middle of the street is free, 1.4 m to both sides."""
    b = SceneBuilder("street", seed)
    x, y = BLOCK[0] / 2 + STREET + 30, BLOCK[1] / 2 + STREET + 30
    b.quad([-x, -y, 0], [2 * x, 0, 0], [0, 2 * y, 0], _ASPHALT)
    for wall in around(*BLOCK, outwards=True):
        _row_of_houses(b, wall, pavement_end=_PAVEMENT)
    for wall in around(BLOCK[0] + 2 * STREET, BLOCK[1] + 2 * STREET, outwards=False):
        _row_of_houses(b, wall, pavement_end=0.0)
        _pavement_life(b, wall)
    return b.scene(Sky(AIR_K - 6.0, AIR_K - 36.0, clouds_k=3.0), ambient_k=AIR_K)


def street_route() -> Route:
    """Along the middle of the street, once round the block."""
    return Route(rounded_rectangle(BLOCK[0] + STREET, BLOCK[1] + STREET, radius=4.0, height=1.6), speed_m_s=1.4, gaze="ahead", room_m=1.0, look_ahead_m=6.0)


def _row_of_houses(b: SceneBuilder, wall: Wall, pavement_end: float) -> None:
    """Houses of different heights side by side, and the pavement before them."""
    length = wall.length + 2 * pavement_end
    b.box(wall.at(wall.length / 2, 0.0, _PAVEMENT / 2), (length, _PAVEMENT, 0.12), _SLABS, wall.yaw)
    b.box(wall.at(wall.length / 2, 0.0, _PAVEMENT + 0.06), (length, 0.12, 0.13), replace(_SLABS, kelvin=AIR_K - 0.2), wall.yaw)
    along = 0.0
    while along < wall.length - 0.1:
        width = float(min(b.rng.uniform(5.5, 9.0), wall.length - along))
        if wall.length - along - width < 3.0:
            width = wall.length - along
        _house(b, wall, along, width)
        along += width


def _house(b: SceneBuilder, wall: Wall, along: float, width: float) -> None:
    floors = int(b.rng.integers(2, 5))
    height = 1.2 + 3.0 * floors
    material = replace(_BRICK if b.rng.random() < 0.5 else _RENDER, kelvin=AIR_K + float(b.rng.uniform(-0.5, 5.5)))
    middle = along + width / 2
    b.box(wall.at(middle, 0.0, -3.0), (width, 6.0, height), material, wall.yaw, spread_k=0.8)
    b.box(wall.at(middle, height, -2.9), (width + 0.1, 6.3, 0.25), replace(_FRAME, kelvin=AIR_K - 0.5), wall.yaw)
    columns = max(2, int(width / 1.9))
    door = int(b.rng.integers(columns))
    for column in range(columns):
        place = along + (column + 0.5) * width / columns
        for floor in range(floors):
            if floor == 0 and column == door:
                wall.box(b, place, 0.12, (1.1, 0.06, 2.3), replace(_FRAME, kelvin=AIR_K + b.rng.uniform(0.5, 3.0)), spread_k=0.4)
                wall.box(b, place, 2.5, (1.5, 0.7, 0.12), _FRAME)
            else:
                _window(b, wall, place, 1.15 + 3.0 * floor)
    for side in (0.15, width - 0.15):
        foot = wall.at(along + side, 0.1, 0.08)
        b.cylinder(foot, foot + [0, 0, height - 0.1], 0.05, replace(STEEL, kelvin=AIR_K - 0.8), ring=8)
    for _ in range(3):
        wall.box(b, along + b.rng.uniform(0.4, width - 0.4), b.rng.uniform(0.4, 2.6), (b.rng.uniform(0.15, 0.5), 0.06, b.rng.uniform(0.15, 0.5)), replace(_LACQUER, kelvin=AIR_K + b.rng.uniform(-1.5, 2.0)))


def _window(b: SceneBuilder, wall: Wall, along: float, up: float) -> None:
    """A window in its frame; it mirrors the sky, and the wall below it is warmed by a radiator."""
    lit = float(b.rng.uniform(-1.0, 5.0))
    wall.box(b, along, up, (1.15, 0.05, 1.5), replace(_FRAME, kelvin=AIR_K + 2.5 + lit), spread_k=0.5)
    for side in (-0.27, 0.27):
        wall.box(b, along + side, up + 0.07, (0.48, 0.06, 1.36), replace(_PANE, kelvin=AIR_K + 1.0 + lit), spread_k=0.4)
    wall.box(b, along, up - 0.08, (1.3, 0.15, 0.06), replace(_SLABS, kelvin=AIR_K - 0.3))
    if b.rng.random() < 0.5:
        wall.box(b, along, up - 0.75, (1.0, 0.02, 0.6), replace(_RENDER, kelvin=AIR_K + 2.0 + lit))


def _pavement_life(b: SceneBuilder, wall: Wall) -> None:
    """Along one street: cars at both kerbs, trees, lamps, bins, manholes, people on the pavements."""
    along = STREET + 1.0
    while along < wall.length - STREET - 1.0:
        for near in (True, False):
            if b.rng.random() < 0.75:
                _car(b, wall.at(along + b.rng.uniform(0, 1.0) + 2.0, 0.0, _PAVEMENT + 1.2 if near else STREET - _PAVEMENT - 1.2), wall.yaw)
        along += 5.6
    along = 4.0
    while along < wall.length - 2.0:
        kind = b.rng.integers(4)
        spot = wall.at(along, 0.12, 1.5)
        if kind <= 1:
            _tree(b, spot)
        elif kind == 2:
            b.cylinder(spot, spot + [0, 0, 5.0], 0.07, STEEL, ring=12)
            b.box(spot + [0, 0, 5.0], (0.3, 0.7, 0.15), replace(HOT, kelvin=AIR_K + 12), wall.yaw)
        else:
            b.box(spot, (0.6, 0.6, 1.1), replace(_LACQUER, kelvin=AIR_K + b.rng.uniform(-1, 2)), wall.yaw + b.rng.uniform(-0.2, 0.2))
            person(b, wall.at(along + 1.4, 0.12, 0.9), wall.yaw + b.rng.uniform(-2, 2))
        if b.rng.random() < 0.6:
            lid = wall.at(along + 1.0, 0.002, STREET / 2 + b.rng.uniform(-1, 1))
            b.cylinder(lid, lid + [0, 0, 0.012], 0.33, replace(STEEL, kelvin=AIR_K + b.rng.uniform(0, 4)), ring=24)
        along += float(b.rng.uniform(3.0, 5.0))


def _car(b: SceneBuilder, place: FloatArray, yaw: float) -> None:
    """A parked car; some have just arrived, with a warm bonnet and wheels."""
    c, s = np.cos(yaw), np.sin(yaw)
    warm = float(b.rng.choice([0.0, 0.0, 6.0]))
    paint = replace(_LACQUER, kelvin=AIR_K - 3.0 + b.rng.uniform(-1.5, 1.5))
    length = float(b.rng.uniform(3.8, 4.6))

    def at(u: float, v: float, up: float) -> FloatArray:
        return np.asarray(place + [c * u - s * v, s * u + c * v, up])

    b.box(at(0, 0, 0.28), (length, 1.72, 0.5), paint, yaw, spread_k=0.4)
    b.box(at(-0.25 * length + 0.55, 0, 0.78), (0.5 * length, 1.6, 0.14), paint, yaw)
    b.box(at(-0.3, 0, 0.78), (0.48 * length, 1.5, 0.58), replace(_PANE, kelvin=AIR_K - 0.5), yaw, spread_k=0.5, top=replace(paint, kelvin=paint.kelvin - 2.0))
    b.box(at(0.37 * length, 0, 0.77), (0.24 * length, 1.5, 0.06), replace(paint, kelvin=paint.kelvin + warm, noise_k=0.2 + 0.15 * warm), yaw)
    b.box(at(length / 2, 0, 0.4), (0.06, 1.2, 0.22), replace(_RUBBER, kelvin=AIR_K + warm), yaw)
    for u in (-0.31 * length, 0.32 * length):
        for v in (-0.87, 0.87):
            b.cylinder(at(u, v - 0.09, 0.31), at(u, v + 0.09, 0.31), 0.31, replace(_RUBBER, kelvin=AIR_K + 0.5 + 0.8 * warm), ring=18)
            b.cylinder(at(u, v - 0.095, 0.31), at(u, v + 0.095, 0.31), 0.17, replace(STEEL, kelvin=AIR_K - 0.5 + 1.2 * warm), ring=14)


def _tree(b: SceneBuilder, foot: FloatArray) -> None:
    height = float(b.rng.uniform(2.2, 3.0))
    b.cylinder(foot, foot + [0, 0, height + 0.6], 0.15, _BARK, ring=14, radius_end=0.09)
    for _ in range(7):
        center = foot + [0, 0, height + 0.8] + b.rng.uniform([-0.8, -0.8, -0.4], [0.8, 0.8, 1.4])
        b.ellipsoid(center, b.rng.uniform(0.5, 0.95, 3), replace(_LEAVES, kelvin=AIR_K + b.rng.uniform(-1.0, 0.4)), rough_m=0.18)
