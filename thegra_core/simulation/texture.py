"""Surface temperature as a function of place: noise, spots and patterns, compiled by numba.

Coordinates are those of the surface itself (metres): on flat faces two in the face's own plane, on curved ones three in the object's space. Every term is
faded out as the pixel's footprint nears its size, so that what a far pixel shows is close to the mean over it, and nothing aliases.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FIELDS = (
    "kelvin",
    "emissivity",
    "mirror",
    "flat",
    "seed",
    "noise_k",
    "noise_m",
    "octaves",
    "spots_k",
    "spots_m",
    "spots_share",
    "pattern",
    "period_u",
    "period_v",
    "line_m",
    "line_k",
    "cell_k",
)
"""Columns of the table of surfaces; `scene.Surface` says what each means."""
(_KELVIN, EMISSIVITY, MIRROR, _FLAT, _SEED, _NOISE_K, _NOISE_M, _OCTAVES, _SPOTS_K, _SPOTS_M, _SPOTS_SHARE, _PATTERN, _PERIOD_U, _PERIOD_V, _LINE_M, _LINE_K, _CELL_K) = range(
    len(FIELDS)
)
PLAIN, PLANKS, TILES, BRICKS = range(4)

_compile = numba.njit(cache=True, error_model="numpy", nogil=True)
_MASK = 0xFFFFFFFF


@_compile
def _hash(x: int, y: int, z: int, seed: int) -> int:
    h = (x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F + seed * 0x9E3779B1) & _MASK
    h = ((h ^ (h >> 16)) * 0x7FEB352D) & _MASK
    h = ((h ^ (h >> 15)) * 0x846CA68B) & _MASK
    return h ^ (h >> 16)


@_compile
def _unit(h: int) -> float:
    return h / 4294967296.0


@_compile
def _slope(h: int, x: float, y: float, z: float) -> float:
    """Dot product with one of the twelve directions to the edges of a cube (Perlin 2002)."""
    h &= 15
    a = x if h < 8 else y
    b = y if h < 4 else (x if h in (12, 14) else z)
    return (a if h & 1 == 0 else -a) + (b if h & 2 == 0 else -b)


@_compile
def _ease(t: float) -> float:
    return t * t * t * (t * (t * 6 - 15) + 10)


@_compile
def noise3(x: float, y: float, z: float, seed: int) -> float:
    """Gradient noise (Perlin 2002) of wavelength about 1: mean 0, standard deviation about 0.28, smooth (C2)."""
    xf, yf, zf = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(xf), int(yf), int(zf)
    x, y, z = x - xf, y - yf, z - zf
    u, v, w = _ease(x), _ease(y), _ease(z)
    total = 0.0
    for c in range(2):
        wz = w if c else 1 - w
        for b in range(2):
            wy = v if b else 1 - v
            near = _slope(_hash(i, j + b, k + c, seed), x, y - b, z - c)
            far = _slope(_hash(i + 1, j + b, k + c, seed), x - 1, y - b, z - c)
            total += wz * wy * (near + u * (far - near))
    return total


@_compile
def noise2(x: float, y: float, seed: int) -> float:
    """Gradient noise in the plane, like `noise3`."""
    xf, yf = np.floor(x), np.floor(y)
    i, j = int(xf), int(yf)
    x, y = x - xf, y - yf
    u, v = _ease(x), _ease(y)
    total = 0.0
    for b in range(2):
        wy = v if b else 1 - v
        h, g = _hash(i, j + b, 0, seed), _hash(i + 1, j + b, 0, seed)
        near = (_unit(h) * 2 - 1) * x + (_unit(_hash(h, 1, 0, seed)) * 2 - 1) * (y - b)
        far = (_unit(g) * 2 - 1) * (x - 1) + (_unit(_hash(g, 1, 0, seed)) * 2 - 1) * (y - b)
        total += wy * (near + u * (far - near))
    return 1.25 * total


@_compile
def _fade(size: float, footprint: float) -> float:
    """1 where a pixel is small beside a feature of `size`, 0 where the feature passes unseen between two pixels."""
    t = min(max(2.0 - 4.0 * footprint / size, 0.0), 1.0)
    return t * t * (3 - 2 * t)


@_compile
def _step(distance: float, softness: float) -> float:
    """0 outside (negative distance), 1 inside, over a band of +-softness."""
    t = min(max(0.5 + 0.5 * distance / softness, 0.0), 1.0)
    return t * t * (3 - 2 * t)


@_compile
def _spot(x: float, y: float, z: float, flat: bool, cell: float, share: float, footprint: float, seed: int) -> float:
    """A disc or bar (in the plane) or a ball, at most one in a cell and wholly inside it; in -1..1."""
    i, j, k = np.floor(x / cell), np.floor(y / cell), 0.0 if flat else np.floor(z / cell)
    h = _hash(int(i), int(j), int(k), seed)
    if _unit(h) > share:
        return 0.0
    h1, h2, h3 = _hash(h, 1, 0, seed), _hash(h, 2, 0, seed), _hash(h, 3, 0, seed)
    radius = (0.1 + 0.25 * _unit(h1)) * cell
    room = cell - 2 * radius
    dx = x - (i * cell + radius + room * _unit(h2))
    dy = y - (j * cell + radius + room * _unit(h3))
    dz = 0.0 if flat else z - (k * cell + radius + room * _unit(_hash(h, 4, 0, seed)))
    softness = max(0.06 * radius + 0.004, footprint)
    strength = _fade(2 * radius, footprint) * (2 * _unit(_hash(h, 5, 0, seed)) - 1)
    if flat and h1 & 1:
        angle = 6.283185307179586 * _unit(_hash(h, 6, 0, seed))
        along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        half = radius * (0.25 + 0.45 * _unit(_hash(h, 7, 0, seed)))
        return strength * _step(0.7 * radius - softness - abs(along), softness) * _step(half - abs(across), softness)
    return strength * _step(radius - softness - np.sqrt(dx * dx + dy * dy + dz * dz), softness)


@_compile
def _line(x: float, period: float, width: float, footprint: float) -> float:
    """Lines of `width` at the multiples of `period`: 1 on a line, less when a pixel is wider than it."""
    distance = abs(x - period * np.round(x / period))
    softness = max(0.4 * width, footprint)
    return _step(0.5 * max(width, footprint) - distance + 0.5 * softness, softness) * width / max(width, footprint) * _fade(period, footprint)


@_compile
def _pattern(s: FloatArray, x: float, y: float, footprint: float, seed: int) -> float:
    """Planks along v, tiles, or bricks: their joints, and a temperature of each piece's own."""
    kind = int(s[_PATTERN])
    pu, pv = s[_PERIOD_U], s[_PERIOD_V]
    if kind == BRICKS:
        x += 0.5 * pu * (int(np.floor(y / pv)) & 1)
    column = int(np.floor(x / pu))
    row = 0 if kind == PLANKS else int(np.floor(y / pv))
    small = pu if kind == PLANKS else min(pu, pv)
    cell = s[_CELL_K] * (2 * _unit(_hash(column, row, 7, seed)) - 1) * _fade(small, footprint)
    joint = _line(x, pu, s[_LINE_M], footprint)
    if kind != PLANKS:
        joint = max(joint, _line(y, pv, s[_LINE_M], footprint))
    return float(cell + s[_LINE_K] * joint)


@_compile
def surface_kelvin(s: FloatArray, x: float, y: float, z: float, footprint: float) -> float:
    """Temperature of a surface (K), without the offset of its vertices.

    Args:
        s: One row of the table of surfaces, see `FIELDS`.
        x, y, z: Place on the surface, metres; z plays no part on flat ones.
        footprint: Size of the pixel on the surface, metres.
    """
    flat, seed = s[_FLAT] > 0, int(s[_SEED])
    kelvin = s[_KELVIN]
    amplitude, wavelength = 2.5 * s[_NOISE_K], s[_NOISE_M]
    for octave in range(int(s[_OCTAVES])):
        fade = _fade(wavelength, footprint) * amplitude
        if fade > 1e-4:
            px, py, pz = x / wavelength, y / wavelength, z / wavelength
            kelvin += fade * (noise2(px, py, seed + octave) if flat else noise3(px, py, pz, seed + octave))
        amplitude *= 0.62
        wavelength *= 0.47
    if s[_SPOTS_K] > 0:
        cell = s[_SPOTS_M]
        kelvin += s[_SPOTS_K] * _spot(x, y, z, flat, cell, s[_SPOTS_SHARE], footprint, seed + 101)
        kelvin += 0.7 * s[_SPOTS_K] * _spot(x + 0.37 * cell, y + 0.61 * cell, z + 0.23 * cell, flat, 0.43 * cell, s[_SPOTS_SHARE], footprint, seed + 102)
    if s[_PATTERN] > 0:
        kelvin += _pattern(s, x, y, footprint, seed + 103)
    return float(kelvin)


@_compile
def noise3_many(points: FloatArray, seed: int) -> FloatArray:
    """`noise3` at points (N, 3)."""
    out = np.empty(len(points))
    for n in range(len(points)):
        out[n] = noise3(points[n, 0], points[n, 1], points[n, 2], seed)
    return out
