"""The map's points as PLY (Turk 1994), binary little endian, coloured by detection score."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from thegra_core.messages import Float32Array, FloatArray

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
_TYPES = {"f4": "float", "u1": "uchar"}


def format_ply(points_world: FloatArray, scores: Float32Array) -> bytes:
    """PLY of points (P, 3) in map units, coloured by the rank of their scores (P,)."""
    vertices = np.zeros(len(points_world), _VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = points_world[:, axis]
    colours = score_colours(scores)
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    properties = "".join(f"property {_TYPES[_VERTEX[name].str[1:]]} {name}\n" for name in _VERTEX.names or ())
    header = f"ply\nformat binary_little_endian 1.0\ncomment map points in map units, colour by score\nelement vertex {len(vertices)}\n{properties}end_header\n"
    return header.encode("ascii") + vertices.tobytes()


def score_colours(scores: Float32Array) -> NDArray[np.uint8]:
    """Colours (P, 3) of scores (P,): by rank, because the networks' scores crowd near 0."""
    if len(scores) == 0:
        return np.empty((0, 3), np.uint8)
    _, rank = np.unique(scores, return_inverse=True)
    return (255 * colormaps["inferno"](0.25 + 0.7 * rank / max(int(rank.max()), 1))[:, :3]).round().astype(np.uint8)
