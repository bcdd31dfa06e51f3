"""Umeyama's similarity against evo's, and rotations of bearings."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from thegra_core.geometry.alignment import align_bearings, umeyama


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**31 - 1), st.floats(0.05, 20.0))
def test_similarity_is_found_again_and_is_evos(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    rotation, translation = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    source = rng.normal(size=(20, 3))
    exact = scale * source @ rotation.T + translation
    found_scale, found_rotation, found_translation = umeyama(source, exact)
    assert found_scale == pytest.approx(scale)
    np.testing.assert_allclose(found_rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found_translation, translation, atol=1e-8)
    noisy = exact + rng.normal(0, 0.3, exact.shape)
    for with_scale in (True, False):
        ours = umeyama(source, noisy, with_scale)
        evos_rotation, evos_translation, evos_scale = umeyama_alignment(source.T, noisy.T, with_scale)
        assert ours[0] == pytest.approx(evos_scale)
        np.testing.assert_allclose(ours[1], evos_rotation, atol=1e-9)
        np.testing.assert_allclose(ours[2], evos_translation, atol=1e-8)


def test_a_mirror_image_is_not_rotated_away() -> None:
    source = np.random.default_rng(3).normal(size=(30, 3))
    _, rotation, _ = umeyama(source, source * [1, 1, -1])
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_degenerate_sets() -> None:
    scale, rotation, translation = umeyama(np.array([[1.0, 2, 3]]), np.array([[4.0, 4, 4]]))
    assert scale == 1.0 and np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(scale * rotation @ [1.0, 2, 3] + translation, [4, 4, 4])
    line = np.outer(np.arange(5.0), [1, 0, 0])
    scale, rotation, translation = umeyama(line, 2 * line + 1)
    np.testing.assert_allclose(scale * line @ rotation.T + translation, 2 * line + 1, atol=1e-12)


def test_weights_decide_between_two_rotations() -> None:
    rng = np.random.default_rng(5)
    rays = rng.normal(size=(40, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    one, other = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix(), Rotation.from_rotvec([-0.3, 0, 0.4]).as_matrix()
    target = np.where(np.arange(40)[:, None] < 20, rays @ one.T, rays @ other.T)
    np.testing.assert_allclose(align_bearings(rays, target, (np.arange(40) < 20).astype(float)), one, atol=1e-9)
    np.testing.assert_allclose(align_bearings(rays, target, (np.arange(40) >= 20).astype(float)), other, atol=1e-9)
    np.testing.assert_allclose(align_bearings(rays, rays @ one.T), one, atol=1e-9)
