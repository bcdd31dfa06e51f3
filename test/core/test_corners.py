"""Corners of images whose corners are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thegra_core.features.corners import APART, corners


def boxes(*places: tuple[float, float], size: float = 20.0, level: int = 200) -> np.ndarray:
    """(160, 200) with bright squares whose upper left corners lie at `places` (x, y) px, drawn at eight times the resolution."""
    fine = np.full((160 * 8, 200 * 8), 60, np.uint8)
    for x, y in places:
        first, last = np.round((np.array([x, y]) + 0.5) * 8).astype(int), np.round((np.array([x, y]) + size + 0.5) * 8).astype(int)
        fine[first[1] : last[1], first[0] : last[0]] = level
    return np.asarray(cv2.GaussianBlur(cv2.resize(fine, (200, 160), interpolation=cv2.INTER_AREA), (0, 0), 1.0))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.25, 0.5), (0.5, 0.125), (-0.375, 0.75)])
def test_the_corners_of_a_box_are_found_below_the_pixel(shift: tuple[float, float]) -> None:
    found = corners(boxes((60 + shift[0], 50 + shift[1])), 4, 8)
    center = np.array([70.0, 60.0]) + shift
    assert sorted(map(tuple, np.sign(found - center).tolist())) == [(-1, -1), (-1, 1), (1, -1), (1, 1)]
    # blurred, a corner is strongest a little inside the box: as far on each side
    np.testing.assert_allclose(np.abs(found - center), np.abs(found - center).mean(), atol=0.35)
    assert 8.5 < np.abs(found - center).mean() < 10


def test_a_corner_moves_with_the_image() -> None:
    one = corners(boxes((60, 50), (120, 90)), 8, 8)
    other = corners(boxes((60.375, 50.625), (120.375, 90.625)), 8, 8)
    distance = np.linalg.norm(other[None] - (one + [0.375, 0.625])[:, None], axis=2)
    assert len(one) == len(other) == 8
    assert distance.min(axis=1).max() < 0.5


def test_the_strongest_come_first() -> None:
    image = np.maximum(boxes((30, 30), level=120), boxes((120, 90), level=220))
    found = corners(image, 8, 8)
    assert len(found) == 8
    assert (found[:4, 0] > 100).all() and (found[4:, 0] < 60).all()


def test_an_edge_is_no_corner() -> None:
    image = np.full((120, 120), 60, np.uint8)
    image[:, 60:] = 200
    assert len(corners(image, 100, 8)) == 0
    cv2.rectangle(image, (20, 50), (40, 70), 200, -1)
    assert np.all(corners(image, 100, 8)[:, 0] < 50)


def test_a_flat_image_has_none() -> None:
    assert corners(np.full((60, 80), 127, np.uint8), 100, 4).shape == (0, 2)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 300), border=st.integers(0, 20))
def test_any_image(seed: int, count: int, border: int) -> None:
    """Apart from each other, inside the border, as many as asked for at the most, and the same first ones if more are asked for."""
    image = cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 256, (70, 90)).astype(np.uint8), (0, 0), 1.0)
    found = corners(np.asarray(image), count, border)
    assert len(found) <= count
    assert (found >= border).all() and (found <= np.array([90, 70]) - 1 - border).all()
    apart = np.abs(found[:, None] - found[None]).max(axis=2) + 100 * np.eye(len(found))
    assert len(found) < 2 or apart.min() >= APART  # whole pixels of two are at least one more apart
    more = corners(np.asarray(image), count + 50, border)
    np.testing.assert_array_equal(more[: len(found)], found)
