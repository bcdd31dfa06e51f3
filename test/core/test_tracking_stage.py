"""Tracking and mapping on a synthetic world, message by message."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, World, cloud, loop, no_features, observe, room, sideways, stamp

from thegra_core.config import ThegraConfig
from thegra_core.geometry import poses
from thegra_core.geometry.alignment import umeyama
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.map import Map
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import Features, Keyframe, MapUpdate, Matches, TrackingState
from thegra_core.optimization.solver import BundleSolver
from thegra_core.tracking.motion import MotionModel
from thegra_core.tracking.stage import TrackingOutput, TrackingStage

CONFIG = ThegraConfig()


class Pair:
    """Tracking and mapping as `Slam` wires them, with every output kept."""

    def __init__(self, config: ThegraConfig = CONFIG, matcher: FakeMatcher | None = None, solver: BundleSolver | None = None) -> None:
        self.matcher = matcher or FakeMatcher()
        self.tracking = TrackingStage(CAMERA, config, self.matcher)
        self.mapper = Mapper(CAMERA, config, self.matcher, solver)
        self.outputs: list[TrackingOutput] = []
        self.updates: list[MapUpdate] = []

    def see(self, features: Features) -> TrackingOutput:
        reference = self.tracking.reference_features
        output = self.tracking.process(features, None if reference is None else self.matcher.match(features, reference))
        if output.dropped_map_id is not None:
            self.mapper.drop(output.dropped_map_id)
        update = None
        if output.initial_map is not None:
            update = self.mapper.initialize(output.initial_map)
        elif output.keyframe is not None:
            update = self.mapper.insert(output.keyframe)
        if update is not None:
            self.tracking.apply(update)
            self.updates.append(update)
        self.outputs.append(output)
        return output

    def run(self, world: World, path: list[np.ndarray], begin: int = 0, noise_px: float = 0.3) -> None:
        for index, pose in enumerate(path, start=begin):
            self.see(observe(world, pose, stamp(index), noise_px, 0.9, 10))


def position_error(outputs: list[TrackingOutput], path: list[np.ndarray]) -> tuple[float, int]:
    """Root mean square of positions after a similarity alignment over the length of the path, and how many frames had one."""
    pairs = [(o.result.world_from_camera[:3, 3], p[:3, 3]) for o, p in zip(outputs, path, strict=True) if o.result.state is TrackingState.TRACKING]
    found, true = np.array([a for a, _ in pairs]), np.array([b for _, b in pairs])
    scale, rotation, translation = umeyama(found, true)
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    return float(np.sqrt(((scale * found @ rotation.T + translation - true) ** 2).sum(axis=1).mean()) / length), len(pairs)


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
            self.tracking.apply(self.mapper.grow(keyframe))
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


def test_repetition_gives_the_same_bytes() -> None:
    pairs = [Pair(matcher=FakeMatcher(wrong=0.1)) for _ in range(2)]
    for pair in pairs:
        pair.run(cloud(count=500, seed=8), sideways(25, 0.05))
    a, b = ([o.result.world_from_camera for o in pair.outputs] for pair in pairs)
    assert [None if p is None else p.tobytes() for p in a] == [None if p is None else p.tobytes() for p in b]


# ---- motion model --------------------------------------------------------------------------------------------------------------------


def test_motion_model_by_hand() -> None:
    model = MotionModel()
    assert model.predict(5) is None and model.twist() is None
    first = poses.transform(np.eye(3), [1.0, 0, 0])
    model.update(1_000_000_000, first)
    np.testing.assert_array_equal(model.predict(2_000_000_000), first)
    turn = poses.transform(poses.so3_exp([0, 0, 0.2]), [0.5, 0, 0])
    model.update(1_500_000_000, first @ turn)
    predicted = model.predict(2_000_000_000)
    np.testing.assert_allclose(predicted[:3, :3], poses.so3_exp([0, 0, 0.4]), atol=1e-12)
    np.testing.assert_allclose(predicted[:3, 3], [2.0, 0, 0])
    np.testing.assert_allclose(model.twist(), [0, 0, 0.4, 1.0, 0, 0], atol=1e-12)
    model.move(Similarity(poses.transform(np.eye(3), [0, 10.0, 0])))
    np.testing.assert_allclose(model.predict(1_500_000_000)[:3, 3], [1.5, 10, 0], atol=1e-12)
    np.testing.assert_allclose(model.twist(), [0, 0, 0.4, 1.0, 0, 0], atol=1e-12)
    assert model.predicted_covariance(2_000_000_000) is None
    covariance = np.diag([0.0, 0, 3, 4, 5, 6]) * 1e-4
    model.update(2_000_000_000, model.predict(2_000_000_000), covariance)
    np.testing.assert_allclose(model.predicted_covariance(2_000_000_000), covariance, atol=1e-12)
    later = model.predicted_covariance(2_500_000_000)
    np.testing.assert_allclose(np.diag(later)[2], 3e-4 + 0.2**2, atol=1e-9)
    np.testing.assert_allclose(np.diag(later)[5], 6e-4 + 0.5**2, atol=1e-9)
    assert (model.since(2_500_000_000), MotionModel().since(0)) == (0.5, np.inf)
    model.reset()
    assert model.predict(5) is None


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
    pair.tracking = TrackingStage(CAMERA, CONFIG, matcher, thorough=FakeMatcher())
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


@pytest.mark.parametrize("thorough", [None, FakeMatcher()])
def test_a_frame_that_the_matcher_does_not_place_is_given_to_the_thorough_one(thorough: FakeMatcher | None) -> None:
    world, path = cloud(count=600, seed=1, low=(-4, -3, 3), high=(8, 3, 8)), sideways(40, 0.05)
    pair = Pair(matcher=(matcher := Sighted()))
    pair.tracking = TrackingStage(CAMERA, CONFIG, matcher, thorough=thorough)
    pair.run(world, path)
    matcher.blind = True
    away = path[28]  # too far from where it would be by now for its landmarks to be sought around their projections
    state = pair.see(observe(world, away, stamp(40), 0.3, 0.9, 10)).result.state
    assert state is (TrackingState.LOST if thorough is None else TrackingState.TRACKING)
