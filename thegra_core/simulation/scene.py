"""Scenes: triangles with the temperature and emissivity of their surfaces, and a sky. World: z up, metres, kelvin."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.texture import FIELDS, PLAIN

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Surface:
    """What a surface is made of, and how its temperature varies over it.

    kelvin: mean temperature. emissivity: of the thermal infrared (8-14 um), seen from the front; at grazing angles it falls. mirror: what is not emitted
    is the reflection of what stands there (polished metal, glass), else that of the mean surroundings.
    noise_k, noise_m, octaves: smooth noise, K (about its standard deviation) and largest wavelength in metres; each octave is about half as long.
    spots_k, spots_m, spots_share: discs and bars of up to +-spots_k kelvin, at most one in a cell of spots_m metres, in this share of the cells.
    pattern: PLAIN, PLANKS, TILES or BRICKS of period_u x period_v metres, with joints line_m wide and line_k kelvin warmer, and up to +-cell_k kelvin a piece.
    """

    kelvin: float
    emissivity: float = 0.93
    mirror: bool = False
    noise_k: float = 0.08
    noise_m: float = 0.8
    octaves: int = 4
    spots_k: float = 0.0
    spots_m: float = 0.5
    spots_share: float = 0.5
    pattern: int = PLAIN
    period_u: float = 1.0
    period_v: float = 1.0
    line_m: float = 0.01
    line_k: float = 0.0
    cell_k: float = 0.0

    def row(self, flat: bool, seed: int) -> tuple[float, ...]:
        """A row of the table that `texture.surface_kelvin` reads."""
        kelvin, emissivity, mirror, *texture = astuple(self)
        row = (kelvin, emissivity, float(mirror), float(flat), float(seed), *map(float, texture))
        assert len(row) == len(FIELDS)
        return row


@dataclass(frozen=True, slots=True)
class Sky:
    """What a ray sees that meets nothing: from `horizon_k` to `zenith_k` kelvin with the sine of its elevation, and clouds of up to +-`clouds_k` kelvin."""

    horizon_k: float
    zenith_k: float
    clouds_k: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Triangles and what they look like.

    vertices (V, 3) float64 world; faces (F, 3) int64; surface_of_face (F,) int64, row of `surfaces`; place (V, 3) float64, coordinates on the surface in
    metres; offset_k (V,) float64 kelvin added at the vertices; surfaces (S, K) float64 with the columns `texture.FIELDS`.
    ambient_k is the mean temperature that dull surfaces reflect.
    """

    name: str
    vertices: FloatArray
    faces: IntArray
    surface_of_face: IntArray
    place: FloatArray
    offset_k: FloatArray
    surfaces: FloatArray
    sky: Sky
    ambient_k: float
