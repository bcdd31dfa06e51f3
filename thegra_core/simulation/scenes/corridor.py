"""Corridors round a block of rooms: a loop of 66 metres with doors, pipes, lamps, lockers, and windows on one side."""

from __future__ import annotations

from dataclasses import replace

from thegra_core.simulation.builder import SceneBuilder
from thegra_core.simulation.materials import ALUMINIUM, CEILING, GLASS, HOT, PAPER, PLASTER, PLASTIC, ROOM_K, STEEL, WOOD, person, radiator
from thegra_core.simulation.routes import Route, rounded_rectangle
from thegra_core.simulation.scene import Scene, Sky, Surface
from thegra_core.simulation.scenes.walls import Wall, around
from thegra_core.simulation.texture import TILES

LOOP = (22.0, 12.0)
WIDTH, HEIGHT = 2.4, 2.7
_LAP = 0.003
_FLOOR = Surface(ROOM_K - 1.0, 0.94, noise_k=0.1, noise_m=1.2, octaves=5, spots_k=0.3, spots_m=0.6, spots_share=0.6, pattern=TILES, period_u=0.6, period_v=0.6, line_m=0.008, line_k=0.15, cell_k=0.08)
_STRATA = (-0.35, -0.35, 0.35, 0.35)


def corridor(seed: int = 0) -> Scene:
    """The corridors; objects reach 0.4 m into them at the most."""
    b = SceneBuilder("corridor", seed)
    x, y = LOOP[0] / 2 + WIDTH, LOOP[1] / 2 + WIDTH
    b.quad([-x, -y, 0], [2 * x, 0, 0], [0, 2 * y, 0], _FLOOR)
    b.quad([-x, -y, HEIGHT], [2 * x, 0, 0], [0, 2 * y, 0], CEILING)
    outer, inner = around(LOOP[0] + WIDTH, LOOP[1] + WIDTH, outwards=False), around(LOOP[0] - WIDTH, LOOP[1] - WIDTH, outwards=True)
    for number, wall in enumerate((*outer, *inner)):
        wall.front(b, HEIGHT, replace(PLASTER, kelvin=PLASTER.kelvin + b.rng.uniform(-0.4, 0.4)), _LAP, _STRATA)
        wall.box(b, wall.length / 2, 0.0, (wall.length, 0.015, 0.1), replace(WOOD, kelvin=ROOM_K - 0.9))
        _furnish(b, wall, windows=number == 0, outside=number < 4)
    for wall in outer:
        _overhead(b, wall)
    person(b, outer[1].at(5.0, 0, 0.3), outer[1].yaw)
    person(b, inner[3].at(4.0, 0, 0.3), inner[3].yaw + 0.4)
    return b.scene(Sky(ROOM_K, ROOM_K), ambient_k=ROOM_K)


def corridor_route() -> Route:
    """Along the middle, once round."""
    return Route(rounded_rectangle(*LOOP, radius=1.3, height=1.5), speed_m_s=1.0, gaze="ahead", room_m=0.75)


def _furnish(b: SceneBuilder, wall: Wall, windows: bool, outside: bool) -> None:
    """Doors at uneven distances, and between them what hangs and stands in corridors."""
    along = 0.6 + (WIDTH if outside else 0.0)
    end = wall.length - along
    while along < end - 1.2:
        if windows:
            _window(b, wall, along + 0.8)
        else:
            _door(b, wall, along + 0.6)
        along += 1.6
        gap = float(b.rng.uniform(0.6, 2.2))
        if along + gap < end:
            _something(b, wall, along + gap / 2, gap)
        along += gap


def _door(b: SceneBuilder, wall: Wall, along: float) -> None:
    """A door in its steel frame, shut or with a warmer or colder room behind."""
    leaf = replace(WOOD, kelvin=ROOM_K + b.rng.uniform(-0.8, 0.8), noise_k=0.12)
    wall.box(b, along, 0.0, (1.02, 0.03, 2.1), replace(STEEL, kelvin=ROOM_K - 0.6))
    wall.box(b, along, 0.01, (0.88, 0.045, 2.03), leaf, spread_k=0.15)
    wall.box(b, along + 0.36, 1.0, (0.12, 0.09, 0.03), replace(ALUMINIUM, emissivity=0.25))
    if b.rng.random() < 0.4:
        wall.box(b, along, 1.35, (0.35, 0.05, 0.45), replace(GLASS, kelvin=ROOM_K + b.rng.uniform(-0.8, 1.5)))
    wall.box(b, along - 0.68, 1.5, (0.18, 0.02, 0.12), replace(PAPER, kelvin=ROOM_K + b.rng.uniform(-0.3, 0.5)))


def _window(b: SceneBuilder, wall: Wall, along: float) -> None:
    """A cold window in its frame, with a radiator below."""
    wall.box(b, along, 0.95, (1.5, 0.04, 1.3), replace(PLASTIC, kelvin=ROOM_K - 2.0), spread_k=0.3)
    for side in (-0.36, 0.36):
        wall.box(b, along + side, 1.02, (0.62, 0.05, 1.15), GLASS, spread_k=0.3)
    if b.rng.random() < 0.7:
        radiator(b, wall.at(along, 0.05, 0.12), wall.yaw, 1.0, ROOM_K + float(b.rng.uniform(4, 18)))


def _something(b: SceneBuilder, wall: Wall, along: float, width: float) -> None:
    kind = b.rng.integers(7)
    if kind == 0 and width > 1.0:  # lockers
        for k in range(int((width - 0.2) / 0.3)):
            wall.box(b, along - width / 2 + 0.25 + 0.3 * k, 0.0, (0.29, 0.38, 1.8), replace(STEEL, kelvin=ROOM_K + b.rng.uniform(-0.4, 0.4), noise_k=0.1), spread_k=0.15)
            wall.box(b, along - width / 2 + 0.34 + 0.3 * k, 1.1, (0.03, 0.4, 0.06), replace(ALUMINIUM, emissivity=0.25))
    elif kind == 1:  # a notice board
        wall.box(b, along, 1.0, (min(width, 1.4) * 0.8, 0.03, 0.9), WOOD)
        for _ in range(5):
            wall.box(b, along + b.rng.uniform(-0.3, 0.3) * min(width, 1.4), b.rng.uniform(1.05, 1.6), (0.2, 0.035, 0.26), replace(PAPER, kelvin=ROOM_K + b.rng.uniform(-0.3, 0.6)))
    elif kind == 2:  # a fire extinguisher
        c = wall.at(along, 0.5, 0.12)
        b.cylinder(c, c + [0, 0, 0.45], 0.07, replace(STEEL, kelvin=ROOM_K - 0.6), ring=16)
        wall.box(b, along, 1.2, (0.2, 0.02, 0.2), PAPER)
    elif kind == 3 and width > 1.0:  # a machine that sells drinks, warm
        wall.box(b, along, 0.0, (0.8, 0.4, 1.8), replace(PLASTIC, kelvin=ROOM_K + 1.5, noise_k=0.3, noise_m=0.5), spread_k=0.4)
        wall.box(b, along - 0.1, 0.7, (0.5, 0.41, 0.9), replace(GLASS, kelvin=ROOM_K - 3.5))
        wall.box(b, along + 0.28, 0.9, (0.14, 0.42, 0.3), replace(HOT, kelvin=ROOM_K + 5))
    elif kind == 4:  # a bench
        wall.box(b, along, 0.42, (min(width, 1.4), 0.38, 0.05), replace(WOOD, kelvin=ROOM_K + b.rng.uniform(-0.3, 1.0)))
        for side in (-0.4, 0.4):
            wall.box(b, along + side * min(width, 1.4), 0.0, (0.05, 0.34, 0.42), STEEL)
    elif kind == 5:  # pictures
        for _ in range(2):
            wall.box(b, along + b.rng.uniform(-0.3, 0.3), b.rng.uniform(1.1, 1.6), (b.rng.uniform(0.25, 0.5), 0.025, b.rng.uniform(0.25, 0.5)), replace(PAPER, kelvin=ROOM_K + b.rng.uniform(-0.4, 0.4)))
    else:  # a riser and a switch
        foot = wall.at(along, 0.0, 0.08)
        b.cylinder(foot, foot + [0, 0, HEIGHT], 0.035, replace(HOT, kelvin=ROOM_K + b.rng.uniform(-3, 12)), ring=12)
        wall.box(b, along + 0.25, 1.1, (0.09, 0.03, 0.09), replace(PLASTIC, kelvin=ROOM_K + 0.8))
    for _ in range(2):
        wall.box(b, along + b.rng.uniform(-0.5, 0.5), float(b.rng.choice([0.3, 2.2, 2.4])), (0.09, 0.02, 0.09), replace(PLASTIC, kelvin=ROOM_K + b.rng.choice([-0.6, 0.6, 1.6])))


def _overhead(b: SceneBuilder, wall: Wall) -> None:
    """Along the outer wall: two pipes and a cable tray; over the middle: lamps, sprinklers, and ventilation."""
    for out, up, radius, kelvin in ((0.2, 2.5, 0.05, ROOM_K + 9), (0.4, 2.52, 0.035, ROOM_K - 4)):
        b.cylinder(wall.at(0.0, up, out), wall.at(wall.length, up, out), radius, replace(HOT, kelvin=kelvin, noise_m=0.6), ring=14)
    for k in range(int(wall.length / 1.5)):
        b.box(wall.at(1.0 + 1.5 * k, 2.42, 0.3), (0.04, 0.5, 0.02), STEEL, wall.yaw)
    along = 1.2
    while along < wall.length - 1.0:
        b.box(wall.at(along, HEIGHT - 0.06, WIDTH / 2 + 0.1), (1.2, 0.18, 0.06), replace(HOT, kelvin=ROOM_K + b.rng.uniform(4, 8)), wall.yaw, spread_k=0.3)
        c = wall.at(along + 1.3, HEIGHT, WIDTH / 2)
        b.cylinder(c, c - [0, 0, 0.06], 0.05, STEEL, ring=10)
        if b.rng.random() < 0.4:
            b.box(wall.at(along + 1.3, HEIGHT - 0.03, WIDTH - 0.4), (0.4, 0.4, 0.03), replace(STEEL, kelvin=ROOM_K - 1.8), wall.yaw)
        along += 2.8
