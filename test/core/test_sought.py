"""A camera that is lost, or was not shown anything: sought and found, or begun anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, cloud, no_features, observe, sideways, stamp
from tracking_pair import CONFIG, Pair, position_error

from thegra_core.config import ThegraConfig
from thegra_core.geometry import poses
from thegra_core.messages import Features, Matches, TrackingState
from thegra_core.tracking.stage import TrackingStage


def test_without_keypoints_tracking_is_lost_and_comes_back() -> None:
    pair = Pair()
    world, path = cloud(count=500, seed=3), sideways(30, 0.05)
    pair.run(world, path[:20])
    for index in (20, 21, 22):
        output = pair.see(no_features(stamp(index)))
        assert output.result.state is TrackingState.LOST and output.result.world_from_camera is None and output.result.reason
    pair.run(world, path[23:], begin=23)
    assert [o.result.state for o in pair.outputs[23:]] == [TrackingState.TRACKING] * 7
    assert (pair.tracking.losses, pair.tracking.relocalizations) == (1, 1)
    assert pair.tracking.map_id == 0


def test_a_single_frame_without_keypoints_is_survived() -> None:
    pair = Pair()
    world, path = cloud(count=500, seed=3), sideways(26, 0.05)
    pair.run(world, path[:20])
    pair.see(no_features(stamp(20)))
    pair.run(world, path[21:], begin=21)
    assert [o.result.state for o in pair.outputs[21:]] == [TrackingState.TRACKING] * 5


def test_a_camera_that_stays_elsewhere_begins_a_new_map_beside_the_old() -> None:
    pair = Pair()
    pair.run(cloud(count=500, seed=4), sideways(20, 0.05))
    pair.run(cloud(count=500, seed=5), sideways(40, 0.05), begin=20)
    states = [o.result.state for o in pair.outputs]
    assert TrackingState.LOST in states[20:26] and states[-10:] == [TrackingState.TRACKING] * 10
    assert pair.mapper.map_ids == [0, 1]
    assert pair.tracking.map_id == 1
    ids = [i for m in (0, 1) for i in pair.mapper.map(m).keyframes]
    assert len(ids) == len(set(ids)), "keyframe ids are unique over all maps"
    assert position_error(pair.outputs[:20], sideways(20, 0.05))[0] < 0.01
    second = [o for o in pair.outputs[20:] if o.result.map_id == 1]
    assert {o.result.map_id for o in pair.outputs[40:]} == {1} and len(second) > 25


def test_a_view_of_few_landmarks_is_placed_by_its_other_matches() -> None:
    """All but a dozen of the landmarks are gone, as where the camera has turned to what the map hardly holds; the keyframe's keypoints are still matched."""
    pair, world, path = Pair(), cloud(count=500, seed=4), sideways(24, 0.05)
    pair.run(world, path[:20])
    before = pair.outputs[-1].result.world_from_camera
    place = pair.tracking._place
    assert place is not None and before is not None
    seen = place.map.keyframes[place.reference_id].landmark_ids
    kept = seen[seen >= 0][:12]
    alive = place.map.landmarks.alive_ids()
    place.map.landmarks.remove(alive[~np.isin(alive, kept)])
    result = pair.tracking.process(observe(world, path[20], stamp(20), 0.3, 0.9, 10), None).result
    assert result.state is TrackingState.TRACKING and result.inliers < CONFIG.tracking.min_inliers
    found, true = poses.inverse(before) @ result.world_from_camera, poses.inverse(path[19]) @ path[20]
    assert np.degrees(poses.rotation_angle(found[:3, :3].T @ true[:3, :3])) < 0.3
    step = float(np.linalg.norm(before[:3, 3] - pair.outputs[-2].result.world_from_camera[:3, 3]))
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(step, rel=0.4)
    none = Pair(ThegraConfig.model_validate({"tracking": {"min_sparse_landmarks": 50}}))
    none.run(world, path[:20])
    place = none.tracking._place
    assert place is not None
    alive = place.map.landmarks.alive_ids()
    place.map.landmarks.remove(alive[~np.isin(alive, kept)])
    assert none.tracking.process(observe(world, path[20], stamp(20), 0.3, 0.9, 10), None).result.state is TrackingState.LOST


def test_after_a_closure_the_place_is_sought_before_it_counts_as_lost() -> None:
    pair = Pair()
    world, elsewhere = cloud(count=500, seed=6), cloud(count=500, seed=60)
    path = sideways(60, 0.05)
    pair.run(world, path[:30])
    pair.tracking.reopen()
    frames = ThegraConfig().relocalization.search_frames
    pair.run(elsewhere, path[30 : 30 + frames], begin=30)
    assert [o.result.state for o in pair.outputs[30:]] == [TrackingState.RELOCALIZING] * frames
    assert all(o.result.world_from_camera is None for o in pair.outputs[30:])
    assert pair.tracking.losses == 0
    pair.run(world, path[30 + frames : 40], begin=30 + frames)
    assert {o.result.state for o in pair.outputs[30 + frames :]} == {TrackingState.TRACKING}
    pair.tracking.reopen()
    pair.run(elsewhere, path[40 : 41 + frames], begin=40)
    assert pair.outputs[-1].result.state is TrackingState.LOST
    assert pair.tracking.losses == 1


def test_frames_without_a_pose_are_placed_afterwards() -> None:
    pair = Pair()
    path = sideways(30, 0.02)
    world = cloud(count=500, seed=7)
    pair.run(world, path)
    waited = {o.result.stamp_ns for o in pair.outputs if o.result.state is TrackingState.INITIALIZING}
    keyframes = pair.mapper.map(0).keyframes
    placed = pair.tracking.localize_afterwards()
    covered = {p.stamp_ns for p in placed} | {k.stamp_ns for k in keyframes.values()}
    assert len(waited) > 2 and waited <= covered
    assert not {p.stamp_ns for p in placed} & {k.stamp_ns for k in keyframes.values()}
    true = {stamp(i): p for i, p in enumerate(path)}
    for p in placed:
        reference = keyframes[p.reference_id]
        expected = poses.inverse(true[reference.stamp_ns]) @ true[p.stamp_ns]
        assert np.degrees(poses.rotation_angle(p.reference_from_camera[:3, :3].T @ expected[:3, :3])) < 0.5


class Sighted(FakeMatcher):
    """Finds nothing while `blind`."""

    blind = False

    def match(self, query: Features, reference: Features) -> Matches:
        found = super().match(query, reference)
        return replace(found, indices=found.indices[:0], confidence=found.confidence[:0]) if self.blind else found


def test_a_frame_after_a_closure_is_found_by_few_landmarks_and_many_matches() -> None:
    """All but a dozen landmarks are gone, and only the thorough matcher sees anything: the last keyframes, whose poses are known, give the rest."""
    world, path = cloud(count=600, seed=1, low=(-4, -3, 3), high=(8, 3, 8)), sideways(40, 0.05)
    pair = Pair(matcher=(matcher := Sighted()))
    pair.tracking = TrackingStage(CAMERA, CONFIG, matcher, thorough=[FakeMatcher()])
    pair.run(world, path)
    place = pair.tracking._place
    assert place is not None
    seen = place.map.keyframes[place.reference_id].landmark_ids
    alive = place.map.landmarks.alive_ids()
    place.map.landmarks.remove(alive[~np.isin(alive, seen[seen >= 0][:12])])
    matcher.blind = True
    pair.tracking.reopen()
    result = pair.tracking.process(observe(world, path[28], stamp(40), 0.3, 0.9, 10), None).result
    assert result.state is TrackingState.TRACKING and result.inliers < CONFIG.tracking.min_inliers


class Counting(Sighted):
    """Counts how often it is asked."""

    asked = 0

    def match(self, query: Features, reference: Features) -> Matches:
        self.asked += 1
        return super().match(query, reference)


@pytest.mark.parametrize("blind", [(), (False, False), (True, False), (True, True)])
def test_a_frame_that_the_matcher_does_not_place_is_given_to_thorough_ones_in_turn(blind: tuple[bool, ...]) -> None:
    world, path = cloud(count=600, seed=1, low=(-4, -3, 3), high=(8, 3, 8)), sideways(40, 0.05)
    pair = Pair(matcher=(matcher := Sighted()))
    thorough = [Counting() for _ in blind]
    pair.tracking = TrackingStage(CAMERA, CONFIG, matcher, thorough=thorough)
    pair.run(world, path)
    matcher.blind = True
    for each, sees_nothing in zip(thorough, blind, strict=True):
        each.blind = sees_nothing
    away = path[28]  # too far from where it would be by now for its landmarks to be sought around their projections
    state = pair.see(observe(world, away, stamp(40), 0.3, 0.9, 10)).result.state
    assert state is (TrackingState.TRACKING if False in blind else TrackingState.LOST)
    assert [bool(each.asked) for each in thorough] == [i == 0 or all(blind[:i]) for i in range(len(blind))]
