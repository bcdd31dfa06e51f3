"""Tracking and mapping on a synthetic world, message by message."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, World, cloud, loop, observe, room, sideways, stamp
from tracking_pair import CONFIG, Pair, position_error

from thegra_core.config import ThegraConfig
from thegra_core.geometry import poses
from thegra_core.geometry.alignment import umeyama
from thegra_core.map.map import Map
from thegra_core.messages import Features, Keyframe, MapUpdate, TrackingState
from thegra_core.tracking.stage import TrackingOutput


@pytest.fixture(scope="module")
def walk() -> Pair:
    pair = Pair()
    pair.run(cloud(count=600, seed=1, low=(-4, -3, 3), high=(8, 3, 8)), sideways(60, 0.05))
    return pair


class PairByHalves(Pair):
    """The same, but tracking gets a keyframe's landmarks before they are adjusted, and then where they are afterwards."""

    def see(self, features: Features) -> TrackingOutput:
        insert = self.mapper.insert

        def by_halves(keyframe: Keyframe) -> MapUpdate:
            updates = list(self.mapper.grow(keyframe))
            assert len(updates) == 2, "of the matches that tracking made, and of the others"
            for update in updates:
                self.tracking.apply(update)
            return self.mapper.settle(keyframe)

        self.mapper.insert = by_halves  # type: ignore[method-assign]
        try:
            return super().see(features)
        finally:
            self.mapper.insert = insert  # type: ignore[method-assign]


def test_a_keyframe_in_halves_leads_to_the_same_poses(walk: Pair) -> None:
    """The motion model follows both halves as it follows the whole."""
    halves = PairByHalves()
    halves.run(cloud(count=600, seed=1, low=(-4, -3, 3), high=(8, 3, 8)), sideways(60, 0.05))
    for one, other in zip(walk.outputs, halves.outputs, strict=True):
        assert one.result.state is other.result.state and (one.keyframe is None) is (other.keyframe is None)
        if one.result.world_from_camera is not None:
            np.testing.assert_allclose(other.result.world_from_camera, one.result.world_from_camera, atol=1e-6)


def test_a_keyframe_is_matched_to_no_more_neighbours_once_others_wait() -> None:
    pair = Pair()
    matched: list[int] = []

    def hurried(keyframe: Keyframe) -> MapUpdate:
        before, answers = pair.matcher.calls, iter([False])
        updates = list(pair.mapper.grow(keyframe, lambda: next(answers, True)))
        matched.append(pair.matcher.calls - before)
        assert len(updates) == 2, "it is in the map all the same"
        for update in updates:
            pair.tracking.apply(update)
        return pair.mapper.settle(keyframe)

    pair.mapper.insert = hurried  # type: ignore[method-assign]
    path = sideways(60, 0.05)
    pair.run(cloud(count=600, seed=1, low=(-4, -3, 3), high=(8, 3, 8)), path)
    assert max(matched) == 1 < CONFIG.mapping.neighbours - 1
    assert position_error(pair.outputs, path)[0] < 0.005


def test_a_walk_is_tracked(walk: Pair) -> None:
    error, tracked = position_error(walk.outputs, sideways(60, 0.05))
    assert error < 0.005
    assert tracked >= 54
    states = [o.result.state for o in walk.outputs]
    first = states.index(TrackingState.TRACKING)
    assert set(states[:first]) == {TrackingState.INITIALIZING} and set(states[first:]) == {TrackingState.TRACKING}
    assert all(o.result.reason for o in walk.outputs[:first])


def test_results_are_whole(walk: Pair) -> None:
    for output in walk.outputs:
        result = output.result
        assert result.stamp_ns >= stamp(0)
        if result.state is not TrackingState.TRACKING:
            assert result.world_from_camera is None
            continue
        assert result.world_from_camera is not None and result.covariance is not None and output.landmark_ids is not None
        assert np.isfinite(result.world_from_camera).all()
        np.testing.assert_allclose(result.world_from_camera[:3, :3] @ result.world_from_camera[:3, :3].T, np.eye(3), atol=1e-9)
        assert (np.linalg.eigvalsh(result.covariance) > 0).all()
        seen = output.landmark_ids[output.landmark_ids >= 0]
        assert len(np.unique(seen)) == len(seen) == result.inliers <= result.visible
        assert result.map_id == 0


def test_covariance_predicts_the_error_to_the_next_frame(walk: Pair) -> None:
    """Relative rotation of neighbouring frames against their covariances; the map's error is common to both."""
    path = sideways(60, 0.05)
    ratios = []
    for i in range(20, 59):
        a, b = walk.outputs[i].result, walk.outputs[i + 1].result
        found = poses.inverse(a.world_from_camera) @ b.world_from_camera
        true = poses.inverse(path[i]) @ path[i + 1]
        error = poses.so3_log(found[:3, :3].T @ true[:3, :3])
        ratios.append(float(error @ error / np.trace(a.covariance[:3, :3] + b.covariance[:3, :3])))
    assert 0.3 < np.mean(ratios) < 3.0


def test_keyframes_are_numbered_and_refer_to_earlier_ones(walk: Pair) -> None:
    ids: list[int] = []
    for output in walk.outputs:
        if output.initial_map is not None:
            ids += [k.id for k in output.initial_map.keyframes]
        if output.keyframe is not None:
            assert output.keyframe.reference_id in ids
            assert output.keyframe.stamp_ns == output.result.stamp_ns
            assert output.result.reference_id == output.keyframe.id
            ids.append(output.keyframe.id)
            assert output.keyframe.seen is not None
            assert (output.keyframe.seen.found <= output.keyframe.seen.visible).all()
    assert ids == list(range(len(ids)))
    assert len(ids) > 5


def test_a_second_replica_is_equal_to_the_map(walk: Pair) -> None:
    replica, original = Map(0, CAMERA), walk.mapper.map(0)
    for update in walk.updates:
        replica.apply(update)
    assert list(replica.keyframes) == list(original.keyframes)
    for i, keyframe in original.keyframes.items():
        assert replica.keyframes[i].world_from_camera.tobytes() == keyframe.world_from_camera.tobytes()
        np.testing.assert_array_equal(replica.keyframes[i].landmark_ids, keyframe.landmark_ids)
    ids = original.landmarks.alive_ids()
    np.testing.assert_array_equal(replica.landmarks.alive_ids(), ids)
    mine, theirs = replica.landmarks.get(ids), original.landmarks.get(ids)
    for name in mine.__slots__:
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), name)
    assert replica.covisibility == original.covisibility
    assert [u.version for u in walk.updates] == list(range(1, len(walk.updates) + 1))


def test_the_map_is_right_up_to_a_similarity(walk: Pair) -> None:
    """Each landmark is one point of the world, and one point of the world is at most a few landmarks."""
    world = cloud(count=600, seed=1, low=(-4, -3, 3), high=(8, 3, 8))
    current = walk.mapper.map(0)
    ids = current.landmarks.alive_ids()
    landmarks = current.landmarks.get(ids)
    similarity = landmarks.descriptors @ world.descriptors.T
    origin = similarity.argmax(axis=1)
    assert (similarity.max(axis=1) > 0.99).mean() > 0.98
    assert np.unique(origin).size > 0.95 * len(ids), "one point of the world is one landmark"
    scale, rotation, translation = umeyama(landmarks.points_world, world.points[origin])
    error = np.linalg.norm(scale * landmarks.points_world @ rotation.T + translation - world.points[origin], axis=1)
    assert np.median(error) < 0.05 and np.percentile(error, 95) < 0.5
    for keyframe in current.keyframes.values():
        seen = keyframe.landmark_ids >= 0
        agree = (keyframe.features.descriptors[seen] * current.landmarks.get(keyframe.landmark_ids[seen]).descriptors).sum(axis=1) > 0.99
        assert agree.mean() > 0.98


def test_work_a_frame_does_not_grow_with_the_map(walk: Pair) -> None:
    """What a frame projects is the local map; what an update restates is the local neighbourhood."""
    landmarks = len(walk.mapper.map(0).landmarks)
    local = walk.mapper.map(0).local_keyframes(max(walk.mapper.map(0).keyframes), CONFIG.tracking.local_keyframes)
    assert len(local) <= CONFIG.tracking.local_keyframes
    assert landmarks < 900
    assert max(len(u.keyframes) for u in walk.updates[1:]) <= CONFIG.bundle.local_keyframes + CONFIG.bundle.fixed_keyframes + 30


def test_wrong_matches_do_not_harm() -> None:
    pair = Pair(matcher=FakeMatcher(wrong=0.3))
    path = sideways(40, 0.05)
    pair.run(cloud(count=600, seed=2, low=(-4, -3, 3), high=(8, 3, 8)), path)
    error, tracked = position_error(pair.outputs, path)
    assert error < 0.01 and tracked >= 32


def test_a_loop_is_tracked() -> None:
    pair, path = Pair(), loop(90)
    pair.run(room(), path)
    error, tracked = position_error(pair.outputs, path)
    assert error < 0.01 and tracked >= 80


def until_first_map(pair: Pair, world: World) -> int:
    """See the world until a map begins; the number of frames that took."""
    for index, pose in enumerate(sideways(40, 0.05)):
        if pair.see(observe(world, pose, stamp(index), 0.3, 0.9, 10)).initial_map is not None:
            return index + 1
    raise AssertionError("no map began")


def test_a_new_map_claims_nothing_until_it_has_been_tracked() -> None:
    pair, world = Pair(), cloud(count=500, seed=4)
    begun = until_first_map(pair, world)
    probation = CONFIG.initialization.probation_frames
    pair.run(world, sideways(40, 0.05)[begun : begun + probation], begin=begun)
    first, *between, claimed = pair.outputs[begun - 1 :]
    for output in (first, *between):
        assert output.result.state is TrackingState.INITIALIZING and output.result.world_from_camera is None and "probation" in output.result.reason
        assert output.provisional is not None and output.provisional.state is TrackingState.TRACKING and output.provisional.covariance is not None
        assert (np.linalg.eigvalsh(output.provisional.covariance) > 0).all()
    assert claimed.provisional is None and claimed.result.state is TrackingState.TRACKING
    hasty = Pair(ThegraConfig.model_validate({"initialization": {"probation_frames": 0}}))
    until_first_map(hasty, world)
    assert hasty.outputs[-1].result.state is TrackingState.TRACKING


def test_a_map_that_the_next_frames_do_not_fit_is_dropped() -> None:
    pair = Pair()
    begun = until_first_map(pair, cloud(count=500, seed=4))
    pair.run(cloud(count=500, seed=5), sideways(60, 0.05)[begun:], begin=begun)
    dropped = [o.dropped_map_id for o in pair.outputs]
    assert dropped.index(0) == begun and pair.mapper.map_ids == [1] and pair.tracking.map_id == 1
    assert {o.result.map_id for o in pair.outputs if o.result.world_from_camera is not None} == {1}
    assert pair.tracking.losses == 0, "nothing was claimed, so nothing was lost"
    pair.tracking.apply(pair.updates[0])
    assert pair.tracking.map_id == 1, "a late update of the dropped map changes nothing"


def test_a_dropped_second_map_leaves_the_first_to_be_found_again() -> None:
    pair, home, path = Pair(), cloud(count=500, seed=4), sideways(60, 0.05)
    pair.run(home, path[:20])
    pair.run(cloud(count=500, seed=5), path[20:50], begin=20)
    begun = next(i for i, o in enumerate(pair.outputs) if o.initial_map is not None and o.initial_map.map_id == 1)
    again = Pair()
    again.run(home, path[:20])
    again.run(cloud(count=500, seed=5), path[20 : begun + 1], begin=20)
    assert again.mapper.map_ids == [0, 1]
    again.run(home, path[begun + 1 : begun + 6], begin=begun + 1)
    after = again.outputs[begun + 1 :]
    assert after[0].dropped_map_id == 1 and after[0].result.state is TrackingState.LOST
    assert {o.result.map_id for o in after[1:]} == {0} and {o.result.state for o in after[1:]} == {TrackingState.TRACKING}
    assert (again.tracking.losses, again.tracking.relocalizations, again.mapper.map_ids) == (1, 1, [0])


def test_a_run_that_ends_on_probation_has_no_map() -> None:
    pair = Pair()
    until_first_map(pair, cloud(count=500, seed=4))
    assert pair.tracking.drop_unproven() == 0
    assert pair.tracking.map_id == -1 and pair.tracking.drop_unproven() is None


def test_hold_predicts_with_constant_velocity_and_changes_nothing() -> None:
    pair = Pair()
    assert pair.tracking.hold(stamp(0), "closed").result.world_from_camera is None
    world, path = cloud(count=500, seed=6), sideways(40, 0.05)
    pair.run(world, path[:20])
    last, before = pair.outputs[-1].result.world_from_camera, pair.outputs[-2].result.world_from_camera
    assert last is not None and before is not None
    held = [pair.tracking.hold(stamp(i), "closed").result for i in range(20, 26)]
    assert {r.state for r in held} == {TrackingState.HOLD}
    step = np.linalg.norm(last[:3, 3] - before[:3, 3])
    moved = np.linalg.norm(held[2].world_from_camera[:3, 3] - last[:3, 3])
    assert moved == pytest.approx(3 * step, rel=0.5)
    pair.run(world, path[26:], begin=26)
    assert {o.result.state for o in pair.outputs[20:]} == {TrackingState.TRACKING}


def test_what_is_held_grows_uncertain_and_ends() -> None:
    pair = Pair()
    pair.run(cloud(count=500, seed=6), sideways(20, 0.05))
    last = pair.outputs[-1].result
    held = [pair.tracking.hold(stamp(i), "closed").result for i in range(20, 25)]
    spreads = [np.sqrt(np.diag(r.covariance)[3:].sum()) for r in [last, *held]]
    assert np.all(np.diff(spreads) > 0)
    np.testing.assert_allclose(spreads[5], 5 * np.sqrt(3) * np.linalg.norm(held[0].world_from_camera[:3, 3] - last.world_from_camera[:3, 3]), rtol=0.1)
    longest = ThegraConfig().preprocessing.shutter.longest_s
    stuck = pair.tracking.hold(last.stamp_ns + int((longest + 0.1) * 1e9), "closed").result
    assert stuck.state is TrackingState.HOLD and stuck.world_from_camera is None and stuck.covariance is None


def test_repetition_gives_the_same_bytes() -> None:
    pairs = [Pair(matcher=FakeMatcher(wrong=0.1)) for _ in range(2)]
    for pair in pairs:
        pair.run(cloud(count=500, seed=8), sideways(25, 0.05))
    a, b = ([o.result.world_from_camera for o in pair.outputs] for pair in pairs)
    assert [None if p is None else p.tobytes() for p in a] == [None if p is None else p.tobytes() for p in b]


# ---- loops ---------------------------------------------------------------------------------------------------------------------------


def test_a_place_seen_again_takes_the_drift_out() -> None:
    path = loop(140, radius=1.5, turns=1.2)
    errors = {}
    for enabled in (False, True):
        config = CONFIG.model_copy(update={"loop": CONFIG.loop.model_copy(update={"enabled": enabled})})
        pair = Pair(config, FakeMatcher(wrong=0.05))
        pair.run(room(count=3000, seed=12), path, noise_px=1.0)
        assert pair.tracking.map_id == 0
        assert (pair.mapper.loops > 0) == enabled
        keyframes = pair.mapper.map(0).keyframes
        rows = [i for i in range(len(path)) if any(k.stamp_ns == stamp(i) for k in keyframes.values())]
        found = np.array([next(k.center for k in keyframes.values() if k.stamp_ns == stamp(i)) for i in rows])
        true = np.array([path[i][:3, 3] for i in rows])
        scale, rotation, translation = umeyama(found, true)
        errors[enabled] = np.sqrt(((scale * found @ rotation.T + translation - true) ** 2).sum(axis=1).mean())
        replica, original = pair.tracking._place.map, pair.mapper.map(0)
        assert replica.keyframes.keys() == original.keyframes.keys()
        for i, keyframe in original.keyframes.items():
            np.testing.assert_array_equal(replica.keyframes[i].world_from_camera, keyframe.world_from_camera)
            np.testing.assert_array_equal(replica.keyframes[i].landmark_ids, keyframe.landmark_ids)
    assert errors[True] < 0.6 * errors[False]
