"""Keypoints that belong to the camera: learnt from what does not move with the rest."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from thegra_core.config import ExtractorConfig, MatcherConfig
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.messages import Features, Matches
from thegra_core.tracking.fixed_pattern import SIGHTINGS, FixedPatternMask, still_in_motion

SIZE = (320, 240)
SPOTS = np.array([[40.0, 60.0], [200.0, 100.0], [300.0, 200.0]])


def features(keypoints, stamp=0):
    keypoints = np.asarray(keypoints, np.float32)
    descriptors = np.full((len(keypoints), 4), 0.5, np.float32)
    return Features(stamp, keypoints, np.linspace(0.1, 1, len(keypoints)).astype(np.float32), descriptors, SIZE, "made")


def one_to_one(query, reference):
    indices = np.repeat(np.arange(len(query), dtype=np.int32)[:, None], 2, axis=1)
    return Matches(query.stamp_ns, reference.stamp_ns, indices, np.linspace(0.2, 0.9, len(query)).astype(np.float32))


def scattered(seed, count=200):
    return np.random.default_rng(seed).uniform((20, 20), (300, 220), (count, 2))


def sighting(seed, shift=(6.0, -3.0), spots=SPOTS):
    """Features of two frames: a scene that has shifted, and spots that have not."""
    points = scattered(seed)
    here = features(np.vstack([points + shift, spots + 0.3]), 1)
    there = features(np.vstack([points, spots]), 0)
    return here, there


def test_what_stands_still_in_a_moving_image():
    here, there = sighting(0)
    still, moving = still_in_motion(here.keypoints, there.keypoints)
    np.testing.assert_array_equal(np.flatnonzero(still), [200, 201, 202])
    np.testing.assert_array_equal(np.flatnonzero(moving), np.arange(200))


def test_point_that_the_camera_moves_towards_is_not_the_cameras():
    points = np.vstack([scattered(1, 40), [[160.0, 120.0]]])
    still, _ = still_in_motion((160, 120) + 1.3 * (points - (160, 120)), points)
    assert not still.any()


def test_standing_camera_learns_nothing():
    mask = FixedPatternMask()
    here, there = sighting(0, shift=(0.2, 0.1))
    for _ in range(10):
        assert len(mask.learn(here, there, one_to_one(here, there))) == 203
    assert mask.apply(here) is here


def test_places_are_masked_after_some_sightings_and_their_matches_at_once():
    mask = FixedPatternMask()
    for i in range(SIGHTINGS):
        here, there = sighting(i)
        assert len(mask.apply(here)) == 203
        matches = mask.learn(here, there, one_to_one(here, there))
        np.testing.assert_array_equal(matches.indices[:, 0], np.arange(200))
        assert len(matches.confidence) == 200
    here, _ = sighting(99)
    kept = mask.apply(here)
    assert {tuple(k) for k in kept.keypoints} >= {tuple(k) for k in here.keypoints[:200] if np.abs(k - SPOTS).max(axis=1).min() > 2}
    assert np.abs(kept.keypoints[:, None] - SPOTS).max(axis=2).min() > 1
    assert len(kept.scores) == len(kept.descriptors) == len(kept)
    mask.forget()
    assert mask.apply(here) is here


def test_places_where_things_move_again_are_unlearnt():
    mask = FixedPatternMask()
    for i in range(SIGHTINGS):
        here, there = sighting(i)
        mask.learn(here, there, one_to_one(here, there))
    for i in range(SIGHTINGS):
        points = scattered(50 + i)
        here = features(np.vstack([points + (6, -3), SPOTS + 0.3]), 1)
        there = features(np.vstack([points, SPOTS + 0.3 - (6, -3)]), 0)
        mask.learn(here, there, one_to_one(here, there))
    assert len(mask.apply(features(SPOTS + 0.3))) == 3


@pytest.mark.parametrize("count", [0, 1, 8])
def test_few_matches_say_nothing(count):
    here = features(scattered(0, count) + 9)
    there = features(scattered(0, count))
    matches = one_to_one(here, there)
    assert FixedPatternMask().learn(here, there, matches) is matches


def test_overlay_on_a_moving_picture_is_found_in_images():
    """A burnt-in reading on real detections and matches: its keypoints go, the scene's stay."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.normal(0, 1, (400, 600)), (0, 0), 2)
    picture = (128 + 40 * picture / picture.std()).clip(0, 255).astype(np.uint8)

    def frame(i):
        image = picture[20 : 20 + SIZE[1], 10 + 8 * i : 10 + 8 * i + SIZE[0]].copy()
        image[80:140, 110:230] = 0
        cv2.putText(image, "12.5 C", (130, 120), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2)
        return image

    settings = ExtractorConfig(name="sift", max_keypoints=512)
    extractor, matcher, mask = make_extractor(settings), make_matcher(MatcherConfig(name="nearest"), settings), FixedPatternMask()
    found = [extractor.extract(frame(i), i) for i in range(8)]
    for last, now in pairwise(found):
        mask.learn(now, last, matcher.match(now, last))

    def on_reading(features):
        return (np.abs(features.keypoints - (170, 110)) < (45, 14)).all(axis=1)

    left = mask.apply(found[-1])
    assert on_reading(found[-1]).sum() > 15
    assert on_reading(left).sum() <= 2
    assert (~on_reading(left)).sum() > 0.97 * (~on_reading(found[-1])).sum()
