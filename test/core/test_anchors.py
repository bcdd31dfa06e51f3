"""Squares that are laid over later images, on pictures whose motion is known."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from test_flow import CONFIG, HEIGHT, WIDTH, front_end, grid, moved, texture, view

from thegra_core.features.anchors import anchor, joined, lay, outgrown, renewed, worn
from thegra_core.features.flow import follow, normalize_contrast
from thegra_core.features.protocols import Wanted
from thegra_core.features.tracks import shared_tracks

SIZE = CONFIG.patch


def ones(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), np.float32)


def warped(picture: np.ndarray, matrix: np.ndarray, gain: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """The picture's middle, and that with the (2, 2) matrix about its centre, each with its (2, 3) map."""
    seen = [view(picture, 0, 0)]
    centre = np.array([WIDTH / 2, HEIGHT / 2])
    first = seen[0][1]
    whole = np.column_stack((matrix, centre - matrix @ centre)) @ np.vstack((first, [0, 0, 1]))
    image = np.clip(gain * cv2.warpAffine(picture, whole, (WIDTH, HEIGHT)).astype(np.float32), 0, 255).astype(np.uint8)
    return image, whole


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(0.4, 1.0), st.floats(-1.0, 1.0))
def test_a_square_is_found_through_any_small_affine_map(a: float, b: float, c: float, d: float, gain: float, off: float) -> None:
    picture, matrix = texture(), np.array([[1 + a, b], [c, 1 + d]])
    first, at_first = view(picture, 0, 0)
    second, at_second = warped(picture, matrix, gain)
    points = grid(16, 100)
    there = moved(points, at_first, at_second).astype(np.float32)
    kept = anchor(normalize_contrast(first), points, ones(points), SIZE)
    places, exact, after = lay(kept, normalize_contrast(second), there + np.float32(off), CONFIG)
    assert exact.mean() > 0.6
    assert np.median(np.linalg.norm(places - there, axis=1)[exact]) < 0.2
    np.testing.assert_allclose(np.median(after.warps[exact], axis=0), matrix, atol=0.05)
    assert (after.similarity[exact] >= CONFIG.exact_similarity).all() and after.similarity.max() <= 1.0


def test_errors_of_the_steps_do_not_add_up() -> None:
    picture = texture()
    rng, zoom = np.random.default_rng(3), np.linspace(1.0, 1.35, 30)
    images = []
    for factor in zoom:
        image, at = warped(picture, factor * np.eye(2))
        images.append((normalize_contrast(np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)), at))
    points = grid(16, 100)
    kept, stepped, places = anchor(images[0][0], points, ones(points), SIZE), points, points
    for (before, _), (after, _) in pairwise(images):
        stepped = follow(before, after, stepped, stepped, CONFIG).points
        places, exact, kept = lay(kept, after, follow(before, after, places, places, CONFIG).points, CONFIG)
    there = moved(points, images[0][1], images[-1][1])
    drifted, laid = (np.median(np.linalg.norm(p - there, axis=1)) for p in (stepped, places))
    assert exact.mean() > 0.7
    assert laid < 0.5 * drifted and laid < 0.3


def test_what_looks_like_something_else_stays_where_the_step_has_led() -> None:
    points = grid()
    kept = anchor(normalize_contrast(view(texture(0), 0, 0)[0]), points, ones(points), SIZE)
    places, exact, after = lay(kept, normalize_contrast(view(texture(1), 0, 0)[0]), points, CONFIG)
    assert exact.mean() < 0.02 and worn(after, CONFIG).mean() > 0.8
    np.testing.assert_array_equal(places[~exact], points[~exact])
    np.testing.assert_array_equal(after.warps[~exact], kept.warps[~exact])


def test_what_has_come_nearer_is_taken_as_it_looks_there() -> None:
    picture, points = texture(), grid(16, 100)
    kept = anchor(normalize_contrast(view(picture, 0, 0)[0]), points, ones(points), SIZE)
    at_first = view(picture, 0, 0)[1]
    for zoom in (1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7):
        image, at = warped(picture, zoom * np.eye(2))
        places, exact, kept = lay(kept, normalize_contrast(image), moved(points, at_first, at).astype(np.float32), CONFIG)
    grown = outgrown(kept)
    assert (exact & grown).sum() > 0.5 * len(points) and not worn(kept, CONFIG)[exact].any()
    rows = np.flatnonzero(grown)
    after = renewed(kept, rows, anchor(normalize_contrast(image), places[rows], ones(rows), SIZE))
    assert not outgrown(after).any()
    np.testing.assert_array_equal(after.squares[~grown], kept.squares[~grown])


def test_a_flat_square_says_nothing_of_its_place() -> None:
    flat, points = np.full((HEIGHT, WIDTH), 90, np.uint8), grid()
    kept = anchor(flat, points, ones(points), SIZE)
    places, exact, after = lay(kept, flat, points, CONFIG)
    assert not exact.any() and worn(after, CONFIG).all() and np.isfinite(after.squares).all()
    np.testing.assert_array_equal(places, points)


def test_squares_at_the_border_and_none_at_all_are_no_trouble() -> None:
    image = normalize_contrast(view(texture(), 0, 0)[0])
    corners = np.array([[0, 0], [WIDTH - 1, HEIGHT - 1], [2, HEIGHT - 3]], np.float32)
    places, _, after = lay(anchor(image, corners, ones(corners), SIZE), image, corners, CONFIG)
    assert np.isfinite(places).all() and np.isfinite(after.warps).all()
    none = anchor(image, corners[:0], ones(corners[:0]), SIZE)
    assert len(lay(none, image, corners[:0], CONFIG)[0]) == 0 and len(joined(none, after)) == 3


def test_images_that_may_not_be_written_to_are_as_good() -> None:
    """Those of messages are."""
    image, points = view(texture(), 0, 0)[0], grid()
    image.flags.writeable = False
    normalized = normalize_contrast(image)
    normalized.flags.writeable = False
    places, exact, _ = lay(anchor(normalized, points, ones(points), SIZE), normalized, points, CONFIG)
    assert exact.all() and np.abs(places - points).max() < 0.01


# ---- in the front end -------------------------------------------------------------------------------------------------------------


def covered(image: np.ndarray, share: float) -> np.ndarray:
    """The image with another picture over that share of its columns."""
    seen, edge = image.copy(), int(share * WIDTH)
    seen[:, :edge] = view(texture(9), 0, 0)[0][:, :edge]
    return seen


def blended(share: float, weight: float) -> np.ndarray:
    """As `covered`, the other picture shining through."""
    image = view(texture(), 0, 0)[0]
    return cv2.addWeighted(image, 1 - weight, covered(image, share), weight, 0)


def test_what_has_become_something_else_is_followed_no_longer() -> None:
    end, _ = front_end()
    end.follow(blended(0.3, 0.0), 0)
    end.detect()
    for i in range(1, 9):  # so slowly that each image looks like the one before
        followed = end.follow(blended(0.3, i / 8), i)
    assert followed is not None
    here, beside = followed.keypoints[:, 0] < 0.3 * WIDTH - SIZE, followed.keypoints[:, 0] > 0.3 * WIDTH + SIZE
    assert here.sum() > 5, "the steps alone do not tell"
    kept = np.isin(followed.track_ids, end.detect(Wanted.MORE).track_ids)
    assert kept[beside].all() and beside.sum() > 20
    assert kept[here].mean() < 0.3


def test_where_everything_looks_different_the_tracks_go_on() -> None:
    end, _ = front_end()
    end.follow(blended(1.0, 0.0), 0)
    end.detect()
    for i in range(1, 9):
        followed = end.follow(blended(1.0, i / 8), i)
    assert followed is not None and len(followed) > 10
    assert len(shared_tracks(end.detect(Wanted.MORE), followed)) == len(followed)
