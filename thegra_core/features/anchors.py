"""Where exactly a followed point lies: the square around it, as it was when it was detected, laid over a later image.

Following from each image to the next adds up the errors of the steps: after some keyframes a point lies pixels from what was detected, on each of them a little
farther, and the map bends to it. A square that is laid over each image by an affine map (Shi and Tomasi 1994) does not drift, and shows when the point
looks like something else. The map is found by inverse compositional steps (Baker and Matthews 2004), without brightness and contrast.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from thegra_core.config import FlowConfig

Image = NDArray[np.uint8]
Points = NDArray[np.float32]
FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

PARAMETERS = 6
"""Of an affine map: the matrix row by row, and the shift."""
MOST_GROWN = 1.5
"""Factor in size, either way, beyond which a square has too few pixels or too many to be compared well."""
_ROUNDS, _CONVERGED_PX, _DAMPING, _LEAST, _FLAT = 8, 0.03, 1e-3, 1e-12, 1e-3
_compile = numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
_IMAGE = numba.types.Array(numba.uint8, 2, "C", readonly=True)  # those of messages are
_VECTOR, _MATRIX, _CUBE = numba.float32[::1], numba.float32[:, ::1], numba.float32[:, :, ::1]


@dataclass(frozen=True, slots=True)
class Anchors:
    """Squares of P pixels around N points.

    squares: (N, P) float32 of mean 0 and norm 1. steps: (N, 6, P) float32, what a difference at each pixel adds to the parameters. warps: (N, 2, 2) float32, by which
    the square lies over the last image in which it was found exactly. similarity: (N,) float32 in [-1, 1], correlation with the last image. scores: (N,) float32
    of the detections.
    """

    squares: FloatArray
    steps: FloatArray
    warps: FloatArray
    similarity: FloatArray
    scores: FloatArray

    def __len__(self) -> int:
        return len(self.squares)

    def chosen(self, rows: IntArray) -> Anchors:
        """Those of the points `rows` (M,)."""
        return Anchors(self.squares[rows], self.steps[rows], self.warps[rows], self.similarity[rows], self.scores[rows])


def anchor(image: Image, points: Points, scores: FloatArray, size: int) -> Anchors:
    """Keep the squares of `size` px around points (N, 2) px of a contrast-normalized image."""
    squares = np.empty((len(points), size * size), np.float32)
    slopes = np.zeros((len(points), PARAMETERS, size * size), np.float32)
    _prepare(image, np.ascontiguousarray(points, np.float32), size, squares, slopes)
    normal = (slopes @ slopes.transpose(0, 2, 1)).astype(np.float64)
    diagonal = np.arange(PARAMETERS)
    normal[:, diagonal, diagonal] = normal[:, diagonal, diagonal] * (1.0 + _DAMPING) + _LEAST
    steps = np.linalg.inv(normal).astype(np.float32) @ slopes
    return Anchors(squares, steps, np.tile(np.eye(2, dtype=np.float32), (len(points), 1, 1)), np.ones(len(points), np.float32), np.asarray(scores, np.float32))


def joined(first: Anchors, second: Anchors) -> Anchors:
    """Those of both."""
    return Anchors(
        np.concatenate((first.squares, second.squares)), np.concatenate((first.steps, second.steps)), np.concatenate((first.warps, second.warps)),
        np.concatenate((first.similarity, second.similarity)), np.concatenate((first.scores, second.scores)),
    )  # fmt: skip


def lay(anchors: Anchors, image: Image, points: Points, config: FlowConfig) -> tuple[Points, BoolArray, Anchors]:
    """Lay the squares over a contrast-normalized image, beginning where following has led, points (N, 2) px.

    Returns:
        Points (N, 2) px, moved where the square was found, which (N,) says; and the anchors after it.
    """
    there, warps = np.array(points, np.float32, order="C"), anchors.warps.copy()
    similarity = np.full(len(points), -1, np.float32)
    exact = np.zeros(len(points), np.bool_)
    _lay(image, anchors.squares, anchors.steps, config.exact_similarity, config.max_exact_px, there, warps, similarity, exact)
    return there, exact, replace(anchors, warps=warps, similarity=similarity)


def worn(anchors: Anchors, config: FlowConfig) -> BoolArray:
    """(N,) which points do not look like their squares any more in the last image."""
    return np.asarray(anchors.similarity < config.worn_similarity)


def outgrown(anchors: Anchors) -> BoolArray:
    """(N,) which squares lie over the last image much larger or smaller than they were."""
    grown = np.sqrt(np.abs(np.linalg.det(anchors.warps)))
    return np.asarray((grown > MOST_GROWN) | (grown < 1 / MOST_GROWN))


def renewed(anchors: Anchors, rows: IntArray, fresh: Anchors) -> Anchors:
    """The squares of `rows` (M,) replaced by others (M,); the scores stay."""
    squares, steps, warps, similarity = anchors.squares.copy(), anchors.steps.copy(), anchors.warps.copy(), anchors.similarity.copy()
    squares[rows], steps[rows], warps[rows], similarity[rows] = fresh.squares, fresh.steps, fresh.warps, fresh.similarity
    return Anchors(squares, steps, warps, similarity, anchors.scores)


@_compile
def _between(image: Image, x: float, y: float) -> float:
    """The value between pixels by bilinear interpolation, beyond the border that of the border."""
    x, y = min(max(x, 0.0), image.shape[1] - 1.001), min(max(y, 0.0), image.shape[0] - 1.001)
    column, row = int(x), int(y)
    right, down = x - column, y - row
    above = image[row, column] + right * (np.float64(image[row, column + 1]) - image[row, column])
    below = image[row + 1, column] + right * (np.float64(image[row + 1, column + 1]) - image[row + 1, column])
    value: float = above + down * (below - above)
    return value


@numba.njit(numba.void(_IMAGE, _MATRIX, numba.int64, _MATRIX, _CUBE), cache=True, nogil=True, fastmath=True, error_model="numpy")
def _prepare(image: Image, points: Points, size: int, squares: FloatArray, all_slopes: FloatArray) -> None:
    """The squares, and how each pixel changes with each parameter; nothing changes where a square is flat."""
    half, pixels = (size - 1) / 2, size * size
    slopes, around = np.empty((PARAMETERS, pixels)), np.empty((size + 2, size + 2))
    for i in range(len(points)):
        for v in range(size + 2):
            for u in range(size + 2):
                around[v, u] = _between(image, points[i, 0] - half - 1 + u, points[i, 1] - half - 1 + v)
        square = around[1:-1, 1:-1].copy().reshape(pixels)
        square -= square.mean()
        norm = np.sqrt((square * square).sum())
        if norm < _FLAT:
            squares[i] = 0.0
            continue
        square /= norm
        for k in range(pixels):
            u, v = k % size, k // size
            right, down = 0.5 * (around[v + 1, u + 2] - around[v + 1, u]), 0.5 * (around[v + 2, u + 1] - around[v, u + 1])
            slopes[0, k], slopes[1, k], slopes[4, k] = right * (u - half), right * (v - half), right
            slopes[2, k], slopes[3, k], slopes[5, k] = down * (u - half), down * (v - half), down
        for p in range(PARAMETERS):  # what brightness and contrast explain is not the map's
            slopes[p] = (slopes[p] - slopes[p].mean() - (slopes[p] * square).sum() * square) / norm
        squares[i], all_slopes[i] = square.astype(np.float32), slopes.astype(np.float32)


@_compile
def _see(image: Image, size: int, x: float, y: float, a: float, b: float, c: float, d: float, seen: FloatArray) -> None:
    """The values of an image where the pixels of a square around (x, y) come to lie."""
    half = np.float32((size - 1) / 2)
    reach_x, reach_y = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    inside = x >= reach_x and y >= reach_y and x + reach_x < image.shape[1] - 1 and y + reach_y < image.shape[0] - 1
    right_end, lower_end = np.float32(image.shape[1] - 1.001), np.float32(image.shape[0] - 1.001)
    k = 0
    for v in range(size):
        row_x, row_y = x + b * (v - half) - a * half, y + d * (v - half) - c * half
        for u in range(size):
            at_x, at_y = row_x + a * u, row_y + c * u
            if not inside:
                at_x, at_y = min(max(at_x, np.float32(0.0)), right_end), min(max(at_y, np.float32(0.0)), lower_end)
            column, row = np.int32(at_x), np.int32(at_y)
            right, down = at_x - np.float32(column), at_y - np.float32(row)
            p00, p01 = np.float32(image[row, column]), np.float32(image[row, column + 1])
            p10, p11 = np.float32(image[row + 1, column]), np.float32(image[row + 1, column + 1])
            above, below = p00 + right * (p01 - p00), p10 + right * (p11 - p10)
            seen[k] = above + down * (below - above)
            k += 1


@numba.njit(numba.void(_IMAGE, _MATRIX, _CUBE, numba.float64, numba.float64, _MATRIX, _CUBE, _VECTOR, numba.boolean[::1]), cache=True, nogil=True, fastmath=True, error_model="numpy")
def _lay(
    image: Image, squares: FloatArray, steps: FloatArray, least_similarity: float, most_px: float, points: Points, warps: FloatArray, similarity: FloatArray, exact: BoolArray,
) -> None:  # fmt: skip
    """In single precision throughout: it takes half the time."""
    pixels = squares.shape[1]
    size = int(np.sqrt(pixels) + 0.5)
    half, one, zero = np.float32((size - 1) / 2), np.float32(1.0), np.float32(0.0)
    seen = np.empty(pixels, np.float32)
    for i in range(len(points)):
        a, b, c, d, x, y = warps[i, 0, 0], warps[i, 0, 1], warps[i, 1, 0], warps[i, 1, 1], points[i, 0], points[i, 1]
        alike = -one
        for _ in range(_ROUNDS):
            _see(image, size, x, y, a, b, c, d, seen)
            mean, norm, alike = zero, zero, zero
            for k in range(pixels):
                mean += seen[k]
            mean /= np.float32(pixels)
            for k in range(pixels):
                seen[k] -= mean
                norm += seen[k] * seen[k]
                alike += seen[k] * squares[i, k]
            if norm < _FLAT:
                alike = -one
                break
            scale = one / np.sqrt(norm)
            alike *= scale
            s0, s1, s2, s3, s4, s5 = zero, zero, zero, zero, zero, zero
            for k in range(pixels):
                difference = seen[k] * scale - squares[i, k]
                s0 += steps[i, 0, k] * difference
                s1 += steps[i, 1, k] * difference
                s2 += steps[i, 2, k] * difference
                s3 += steps[i, 3, k] * difference
                s4 += steps[i, 4, k] * difference
                s5 += steps[i, 5, k] * difference
            determinant = (one + s0) * (one + s3) - s1 * s2
            if not 0.3 < determinant < 3.0:
                alike = -one
                break
            # the map after the inverse of the step
            i00, i01, i10, i11 = (one + s3) / determinant, -s1 / determinant, -s2 / determinant, (one + s0) / determinant
            a, b, c, d = a * i00 + b * i10, a * i01 + b * i11, c * i00 + d * i10, c * i01 + d * i11
            dx, dy = a * s4 + b * s5, c * s4 + d * s5
            x, y = x - dx, y - dy
            turned_px = half * max(abs(s0), abs(s1), abs(s2), abs(s3))
            if dx * dx + dy * dy < _CONVERGED_PX * _CONVERGED_PX and turned_px < 5 * _CONVERGED_PX:
                break
        moved_x, moved_y = x - points[i, 0], y - points[i, 1]
        if moved_x * moved_x + moved_y * moved_y > most_px * most_px:  # smooth squares come to look alike elsewhere
            continue
        similarity[i] = min(alike, one)
        if alike >= least_similarity:
            exact[i] = True
            points[i, 0], points[i, 1] = x, y
            warps[i, 0, 0], warps[i, 0, 1], warps[i, 1, 0], warps[i, 1, 1] = a, b, c, d
