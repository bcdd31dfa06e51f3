"""Apparent temperature of what rays meet, compiled by numba: emission, reflection, sky."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.texture import EMISSIVITY, MIRROR, noise3, surface_kelvin

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_compile = numba.njit(cache=True, error_model="numpy", nogil=True)

MIRROR_BELOW = 0.99
"""Apparent emissivity above which a mirror's reflection is not traced."""
_LEAST_COSINE = 0.08  # a pixel on a surface seen at a more grazing angle counts as no longer than this makes it


@_compile
def sky_kelvin(direction: FloatArray, sky: tuple[float, float, float]) -> float:
    """Temperature of the sky in a unit direction (3,): (horizon, zenith, clouds) K."""
    horizon, zenith, clouds = sky
    up = min(max(direction[2], 0.0), 1.0)
    kelvin = zenith + (horizon - zenith) * (1 - up) ** 3
    if clouds > 0:
        # on a plane overhead, as clouds are, and thinned towards the horizon
        scale = 1.5 / (0.15 + up)
        kelvin += clouds * (noise3(direction[0] * scale, direction[1] * scale, 0.37, 11) + 0.5 * noise3(direction[0] * scale * 2.1, direction[1] * scale * 2.1, 0.7, 12)) * 2 * up
    return float(kelvin)


@_compile
def shade(
    origins: FloatArray,
    directions: FloatArray,
    hits: IntArray,
    triangles: FloatArray,
    places: FloatArray,
    offsets: FloatArray,
    surface_of_face: IntArray,
    surfaces: FloatArray,
    sky: tuple[float, float, float],
    ambient_k: float,
    pixel_rad: float,
    path_m: FloatArray,
    kelvin: FloatArray,
    distance: FloatArray,
    reflected: FloatArray,
    normals: FloatArray,
) -> None:
    """Fill in what each ray sees.

    Args:
        origins, directions: (N, 3); directions of any length.
        hits: (N,) triangle of each ray, -1 for the sky.
        triangles, places, offsets: (F, 3, 3), (F, 3, 3), (F, 3): corners, their coordinates on the surface, and kelvin added there.
        sky: (horizon, zenith, clouds) K.
        pixel_rad: Angle between neighbouring pixels.
        path_m: (N,) length of the way to `origins`, for the footprint of reflected rays.
        kelvin: (N,) out: apparent temperature, without a mirror's reflection.
        distance: (N,) out: along the ray in lengths of its direction, inf for the sky.
        reflected: (N,) out: the share that a mirror reflects, 0 elsewhere.
        normals: (N, 3) out: unit normal towards the ray's origin.
    """
    direction = np.empty(3)
    for n in range(len(directions)):
        length = np.sqrt(directions[n, 0] ** 2 + directions[n, 1] ** 2 + directions[n, 2] ** 2)
        for i in range(3):
            direction[i] = directions[n, i] / length
        face = hits[n]
        reflected[n] = 0.0
        if face < 0:
            distance[n] = np.inf
            kelvin[n] = sky_kelvin(direction, sky) if length > 0 else ambient_k
            continue
        a, b, c = triangles[face, 0], triangles[face, 1], triangles[face, 2]
        e1x, e1y, e1z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        e2x, e2y, e2z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        along = nx * direction[0] + ny * direction[1] + nz * direction[2]
        sx, sy, sz = origins[n, 0] - a[0], origins[n, 1] - a[1], origins[n, 2] - a[2]
        t = -(nx * sx + ny * sy + nz * sz) / along
        px, py, pz = sx + t * direction[0], sy + t * direction[1], sz + t * direction[2]
        # barycentric coordinates: areas over the whole, each by a cross product with the normal
        w1 = ((py * e2z - pz * e2y) * nx + (pz * e2x - px * e2z) * ny + (px * e2y - py * e2x) * nz) / (area * area)
        w2 = ((e1y * pz - e1z * py) * nx + (e1z * px - e1x * pz) * ny + (e1x * py - e1y * px) * nz) / (area * area)
        w0 = 1 - w1 - w2
        cosine = abs(along) / area
        sign = -1.0 if along > 0 else 1.0
        normals[n, 0], normals[n, 1], normals[n, 2] = sign * nx / area, sign * ny / area, sign * nz / area
        surface = surfaces[surface_of_face[face]]
        x = w0 * places[face, 0, 0] + w1 * places[face, 1, 0] + w2 * places[face, 2, 0]
        y = w0 * places[face, 0, 1] + w1 * places[face, 1, 1] + w2 * places[face, 2, 1]
        z = w0 * places[face, 0, 2] + w1 * places[face, 1, 2] + w2 * places[face, 2, 2]
        # mean of the footprint's two sides: the longer one alone would blur slanted walls too early, the shorter one alias
        footprint = (t + path_m[n]) * pixel_rad / np.sqrt(max(cosine, _LEAST_COSINE))
        emitted = surface_kelvin(surface, x, y, z, footprint) + w0 * offsets[face, 0] + w1 * offsets[face, 1] + w2 * offsets[face, 2]
        emissivity = surface[EMISSIVITY] * (1 - (1 - cosine) ** 5)  # Schlick 1994
        if surface[MIRROR] > 0 and emissivity < MIRROR_BELOW:
            kelvin[n] = emissivity * emitted
            reflected[n] = 1 - emissivity
        else:
            up = sign * nz / area
            above = sky[0] + (sky[1] - sky[0]) * 0.5
            around = ambient_k + (above - ambient_k) * max(0.0, 0.5 + 0.5 * up)
            kelvin[n] = emissivity * emitted + (1 - emissivity) * around
        distance[n] = t / length
