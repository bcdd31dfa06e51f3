"""Materials and their emissivity between 8 and 14 um, and the things that stand about in more than one scene.

Emissivities: the tables that makers of thermal cameras print (skin 0.98, paint 0.92-0.97, brick and plaster 0.91-0.93, wood 0.90-0.94, glass 0.84-0.94,
plastics 0.94, oxidised steel 0.79, polished aluminium 0.04-0.09). Temperatures are those of a mild day indoors; differences of fractions of a kelvin.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from thegra_core.simulation.builder import SceneBuilder
from thegra_core.simulation.scene import Surface
from thegra_core.simulation.texture import PLANKS, TILES

ROOM_K = 294.0

PLASTER = Surface(
    ROOM_K, 0.92, noise_k=0.07, noise_m=1.1, octaves=5, spots_k=0.22, spots_m=0.5, spots_share=0.5, pattern=PLANKS, period_u=0.625, line_m=0.05, line_k=-0.12
)
"""A plastered wall: stains, and the studs behind it as faint vertical lines."""
CARPET = Surface(ROOM_K - 0.8, 0.94, noise_k=0.1, noise_m=0.9, octaves=5, spots_k=0.3, spots_m=0.45, spots_share=0.6, pattern=TILES, period_u=0.5, period_v=0.5, line_m=0.008, line_k=0.12, cell_k=0.08)
CEILING = Surface(ROOM_K + 0.7, 0.92, noise_k=0.06, noise_m=1.0, spots_k=0.2, spots_m=0.6, spots_share=0.4, pattern=TILES, period_u=0.6, period_v=0.6, line_m=0.02, line_k=0.25, cell_k=0.12)
WOOD = Surface(ROOM_K - 0.2, 0.91, noise_k=0.08, noise_m=0.35, octaves=4, spots_k=0.2, spots_m=0.25, spots_share=0.5)
PAPER = Surface(ROOM_K + 0.1, 0.95, noise_k=0.06, noise_m=0.2, octaves=3, spots_k=0.25, spots_m=0.12, spots_share=0.7)
PLASTIC = Surface(ROOM_K + 0.3, 0.94, noise_k=0.05, noise_m=0.2, octaves=3, spots_k=0.2, spots_m=0.15, spots_share=0.5)
STEEL = Surface(ROOM_K, 0.79, noise_k=0.06, noise_m=0.3, octaves=3)
ALUMINIUM = Surface(ROOM_K, 0.09, mirror=True, noise_k=0.05, noise_m=0.5, octaves=2)
GLASS = Surface(ROOM_K - 4.0, 0.86, mirror=True, noise_k=0.25, noise_m=0.8, octaves=3)
CLOTHES = Surface(ROOM_K + 7.0, 0.95, noise_k=0.7, noise_m=0.22, octaves=4, spots_k=0.6, spots_m=0.25, spots_share=0.4)
SKIN = Surface(ROOM_K + 12.5, 0.98, noise_k=0.5, noise_m=0.1, octaves=3)
HOT = Surface(ROOM_K + 14.0, 0.93, noise_k=0.5, noise_m=0.2, octaves=3)


def person(b: SceneBuilder, feet: ArrayLike, yaw: float = 0.0, seated: bool = False) -> None:
    """A person of 1.75 m, standing or seated, who keeps still."""
    x, y, z = np.asarray(feet, dtype=np.float64)
    side, front = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    hip = np.array([x, y, z + (0.48 if seated else 0.9)])
    clothes, trousers = replace(CLOTHES, kelvin=CLOTHES.kelvin + b.rng.uniform(-2, 1)), replace(CLOTHES, kelvin=CLOTHES.kelvin - 1.5)
    for sign in (-1, 1):
        leg, knee = hip + sign * 0.1 * side, hip + sign * 0.1 * side + 0.42 * front
        if seated:
            b.cylinder(leg, knee, 0.08, trousers, ring=14)
            b.cylinder(knee, [knee[0], knee[1], z], 0.065, trousers, ring=14)
        else:
            b.cylinder(leg, [leg[0], leg[1], z], 0.085, trousers, ring=14, radius_end=0.06)
        shoulder = hip + sign * 0.22 * side + np.array([0, 0, 0.5])
        elbow = shoulder + sign * 0.04 * side + np.array([0, 0, -0.3])
        hand = elbow + 0.2 * front + np.array([0, 0, -0.12])
        b.cylinder(shoulder, elbow, 0.05, clothes, ring=12)
        b.cylinder(elbow, hand, 0.04, SKIN, ring=12)
    b.ellipsoid(hip + np.array([0, 0, 0.28]), [0.2, 0.13, 0.36], clothes, yaw)
    b.cylinder(hip + np.array([0, 0, 0.55]), hip + np.array([0, 0, 0.7]), 0.055, SKIN, ring=12)
    b.ellipsoid(hip + np.array([0, 0, 0.76]), [0.085, 0.105, 0.13], SKIN, yaw)


def shelf(b: SceneBuilder, base: ArrayLike, yaw: float, width: float = 1.0, height: float = 1.9, depth: float = 0.32) -> None:
    """An open shelf full of books and boxes; `base` is the middle of its floor area."""
    origin, c, s = np.asarray(base, dtype=np.float64), np.cos(yaw), np.sin(yaw)

    def at(u: float, v: float, up: float) -> list[float]:
        return [origin[0] + c * u - s * v, origin[1] + s * u + c * v, origin[2] + up]

    for u in (-width / 2, width / 2):
        b.box(at(u, 0, 0), (0.03, depth, height), WOOD, yaw)
    b.box(at(0, -depth / 2 + 0.01, 0), (width, 0.015, height), WOOD, yaw)
    levels = np.linspace(0.05, height - 0.02, max(3, round(height / 0.38)))
    for low, high in itertools.pairwise(levels):
        b.box(at(0, 0, low - 0.02), (width, depth, 0.02), WOOD, yaw)
        u = -width / 2 + 0.03
        while u < width / 2 - 0.1:
            thick = float(b.rng.choice([0.03, 0.04, 0.06, 0.09, 0.18]))
            if b.rng.random() < 0.8:
                tall, deep = b.rng.uniform(0.5, 0.9) * (high - low), b.rng.uniform(0.55, 0.9) * depth
                paper = replace(PAPER, kelvin=PAPER.kelvin + b.rng.uniform(-0.45, 0.45))
                b.box(at(u + thick / 2, -depth / 2 + 0.02 + deep / 2, low), (thick - 0.003, deep, tall), paper, yaw)
            u += thick
    b.box(at(0, 0, height - 0.02), (width + 0.03, depth, 0.02), WOOD, yaw)


def table(b: SceneBuilder, base: ArrayLike, size: tuple[float, float], yaw: float, height: float = 0.74) -> None:
    """A table on four steel legs."""
    origin, c, s = np.asarray(base, dtype=np.float64), np.cos(yaw), np.sin(yaw)
    b.box(origin + [0, 0, height - 0.03], (size[0], size[1], 0.03), WOOD, yaw)
    for u in (-size[0] / 2 + 0.06, size[0] / 2 - 0.06):
        for v in (-size[1] / 2 + 0.06, size[1] / 2 - 0.06):
            b.box(origin + [c * u - s * v, s * u + c * v, 0], (0.05, 0.05, height - 0.03), STEEL, yaw)


def chair(b: SceneBuilder, base: ArrayLike, yaw: float, warm_k: float = 0.0) -> None:
    """An office chair; `warm_k` if somebody has just left it."""
    origin = np.asarray(base, dtype=np.float64)
    back = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    seat = replace(PLASTIC, kelvin=PLASTIC.kelvin + warm_k)
    b.box(origin + [0, 0, 0.43], (0.46, 0.46, 0.06), seat, yaw, top=replace(seat, kelvin=seat.kelvin + warm_k, noise_k=0.1 + 0.3 * warm_k))
    b.box(origin + 0.22 * back + [0, 0, 0.5], (0.44, 0.05, 0.5), seat, yaw)
    b.cylinder(origin + [0, 0, 0.05], origin + [0, 0, 0.43], 0.03, STEEL, ring=12)
    for angle in yaw + np.arange(5) * 2 * np.pi / 5:
        b.cylinder(origin + [0, 0, 0.06], origin + [0.28 * np.cos(angle), 0.28 * np.sin(angle), 0.03], 0.02, STEEL, ring=8)


def radiator(b: SceneBuilder, base: ArrayLike, yaw: float, width: float = 1.2, kelvin: float = ROOM_K + 18.0) -> None:
    """A radiator with ribs, valve and pipe, warmer at the top."""
    origin, c, s = np.asarray(base, dtype=np.float64), np.cos(yaw), np.sin(yaw)
    hot = Surface(kelvin, 0.93, noise_k=0.4, noise_m=0.3, octaves=3)
    count = round(width / 0.08)
    for k in range(count):
        u = (k + 0.5) / count * width - width / 2
        rib = replace(hot, kelvin=kelvin - 4.0 * k / count + b.rng.uniform(-0.3, 0.3))
        b.box(origin + [c * u, s * u, 0.15], (0.055, 0.09, 0.55), rib, yaw)
    for height in (0.2, 0.63):
        b.box(origin + [0, 0, height], (width, 0.05, 0.04), hot, yaw)
    end = origin + [c * (width / 2 + 0.06), s * (width / 2 + 0.06), 0.0]
    b.cylinder(end, end + [0, 0, 0.22], 0.015, replace(hot, kelvin=kelvin + 3), ring=10)
    b.cylinder(end + [0, 0, 0.22], end + [0, 0, 0.3], 0.03, PLASTIC, ring=10)
