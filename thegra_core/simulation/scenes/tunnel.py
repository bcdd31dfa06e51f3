"""A cave of rough rock that closes on itself: damp and dry patches, boulders, a pipe, lamps, timber."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.builder import SceneBuilder
from thegra_core.simulation.materials import HOT, STEEL, WOOD
from thegra_core.simulation.routes import Route, Way
from thegra_core.simulation.scene import Scene, Sky, Surface
from thegra_core.simulation.texture import noise3_many

FloatArray = NDArray[np.float64]

ROCK_K = 284.5
RADIUS = 1.9
_FLOOR = -1.35  # below the middle line
_ROUGH = ((1.9, 0.34), (0.75, 0.17), (0.3, 0.07))  # wavelength, height (m)
_RING, _STEP_M = 96, 0.13
_ROCK = Surface(ROCK_K, 0.94, noise_k=0.28, noise_m=2.2, octaves=6, spots_k=0.45, spots_m=0.6, spots_share=0.5)


def tunnel(seed: int = 0) -> Scene:
    """The cave; the rock keeps about 0.9 m from the middle line, and at the floor what lies there keeps to the sides."""
    b = SceneBuilder("tunnel", seed)
    way = Way(tunnel_route())
    arcs = np.arange(0, way.length_m, way.length_m / round(way.length_m / _STEP_M))
    center, side, up = _frames(way, arcs)
    _rock(b, center, side, up)
    for k in range(int(way.length_m / 6)):
        _lamp(b, *(value[0] for value in _frames(way, np.array([6.0 * k + 2.0]))))
    _pipe(b, way)
    for arc in b.rng.uniform(0, way.length_m, 42):
        _boulder(b, *(value[0] for value in _frames(way, np.array([arc]))))
    for arc in (8.0, 9.5, 11.0, 12.5, 31.0, 32.5, 34.0):
        _timber(b, *(value[0] for value in _frames(way, np.array([arc]))))
    return b.scene(Sky(ROCK_K, ROCK_K), ambient_k=ROCK_K)


def tunnel_route() -> Route:
    """An uneven ring of about 62 m that rises and falls by a metre."""
    angles = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    radius = 9.3 + 1.3 * np.sin(2 * angles + 0.4) + 0.9 * np.sin(3 * angles + 1.9)
    height = 0.5 * np.sin(angles) + 0.3 * np.sin(2 * angles + 1.0)
    return Route(np.c_[radius * np.cos(angles), radius * np.sin(angles), height], speed_m_s=0.9, gaze="ahead", room_m=0.75, look_ahead_m=2.5)


def _frames(way: Way, arcs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Middle (N, 3), unit side (level) and unit up (N, 3) at arc lengths."""
    center = way.at(arcs)
    tangent = way.at(arcs + 0.05) - way.at(arcs - 0.05)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross([0.0, 0.0, 1.0], tangent)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return center, side, np.cross(tangent, side)


def _rock(b: SceneBuilder, center: FloatArray, side: FloatArray, up: FloatArray) -> None:
    """A tube displaced by noise; hollows are damp and colder, what juts out is warmer, and the roof warmer than the floor."""
    angles = np.linspace(0, 2 * np.pi, _RING, endpoint=False)
    across, high = RADIUS * np.cos(angles), np.maximum(RADIUS * np.sin(angles), _FLOOR)
    outwards = np.cos(angles)[None, :, None] * side[:, None] + np.sin(angles)[None, :, None] * up[:, None]
    smooth = center[:, None] + across[None, :, None] * side[:, None] + high[None, :, None] * up[:, None]
    points = smooth.reshape(-1, 3)
    seed = int(b.rng.integers(1, 2**20))
    rough = sum(height * 2.0 * noise3_many(points / wavelength, seed + k) for k, (wavelength, height) in enumerate(_ROUGH))
    floor = np.tile(np.sin(angles) * RADIUS < _FLOOR, len(center))
    rough = np.where(floor, 0.35 * rough, np.maximum(rough, -0.45))
    vertices = points + rough[:, None] * outwards.reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(center)), np.arange(_RING), indexing="ij")
    next_i, next_j = (i + 1) % len(center), (j + 1) % _RING
    corner = [(p * _RING + q).ravel() for p, q in ((i, j), (next_i, j), (next_i, next_j), (i, next_j))]
    faces = np.concatenate([np.stack([corner[0], corner[1], corner[2]], axis=1), np.stack([corner[0], corner[2], corner[3]], axis=1)])
    strata = 0.5 * np.tile(high / RADIUS, len(center))
    b.mesh(vertices, faces, _ROCK, points, strata - 1.2 * rough)


def _lamp(b: SceneBuilder, center: FloatArray, side: FloatArray, up: FloatArray) -> None:
    b.cylinder(center + 1.9 * up + 0.3 * side, center + 1.05 * up + 0.3 * side, 0.012, STEEL, ring=6)
    b.ellipsoid(center + 1.0 * up + 0.3 * side, (0.09, 0.09, 0.11), replace(HOT, kelvin=ROCK_K + 18), subdivisions=2)


def _pipe(b: SceneBuilder, way: Way) -> None:
    """A pipe of warm air and a cable along one wall, on brackets."""
    arcs = np.linspace(0, way.length_m, 61)
    center, side, up = _frames(way, arcs)
    for across, high, radius, kelvin in ((1.15, -0.55, 0.11, ROCK_K + 1.2), (-1.15, 0.55, 0.025, ROCK_K + 2.5)):
        line = center + across * side + high * up
        for start, end in itertools.pairwise(line):
            b.cylinder(start, end, radius, Surface(kelvin, 0.85, noise_k=0.15, noise_m=0.5, octaves=3), ring=16, caps=False)
            b.cylinder(start, start + 0.06 * (end - start), radius * 1.25, replace(STEEL, kelvin=kelvin - 0.5), ring=16)


def _boulder(b: SceneBuilder, center: FloatArray, side: FloatArray, up: FloatArray) -> None:
    place = center + float(b.rng.choice([-1, 1])) * b.rng.uniform(0.85, 1.3) * side + (_FLOOR + 0.05) * up
    b.ellipsoid(place, b.rng.uniform(0.12, 0.38, 3), replace(_ROCK, kelvin=ROCK_K - 0.3 + b.rng.uniform(-0.8, 0.5), noise_m=0.6), yaw=float(b.rng.uniform(0, 6)), rough_m=0.08)


def _timber(b: SceneBuilder, center: FloatArray, side: FloatArray, up: FloatArray) -> None:
    """Two posts and a beam."""
    wood = replace(WOOD, kelvin=ROCK_K + 0.6, noise_k=0.15)
    for across in (-1.1, 1.1):
        b.cylinder(center + across * side - 1.5 * up, center + across * side + 1.25 * up, 0.1, replace(wood, kelvin=wood.kelvin + b.rng.uniform(-0.3, 0.3)), ring=14)
    b.cylinder(center - 1.4 * side + 1.3 * up, center + 1.4 * side + 1.3 * up, 0.11, wood, ring=14)
