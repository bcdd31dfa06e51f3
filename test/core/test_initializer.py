"""Starting a map on synthetic features: when it must, when it must not, and that it says why it waits."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, World, cloud, look, motion_error, no_features, observe, plane, sideways, stamp

from thegra_core.config import InitializationConfig, ThegraConfig
from thegra_core.geometry import poses, triangulation
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.messages import InitialMap
from thegra_core.tracking import first_map
from thegra_core.tracking import initializer as initializer_module
from thegra_core.tracking.hypotheses import MotionHypothesis, motion_hypotheses, parallax_to_noise
from thegra_core.tracking.initializer import Initializer

CONFIG = ThegraConfig()


def run(
    world: World, path: list[np.ndarray], matcher: FakeMatcher | None = None, config: ThegraConfig = CONFIG, noise_px: float = 0.3, offset: int = 0, clutter: int = 20
) -> tuple[InitialMap | None, int, list[str]]:
    """Frames through an initializer until it starts: the map, the index of the frame, and what it said before."""
    initializer = Initializer(CAMERA, config, matcher or FakeMatcher())
    said: list[str] = []
    for index, pose in enumerate(path):
        answer = initializer.add(observe(world, pose, stamp(index + offset), noise_px, 0.85, clutter), None, 3, 7)
        if isinstance(answer, InitialMap):
            return answer, index, said
        said.append(answer)
    return None, len(path), said


def true_relative(path: list[np.ndarray], initial: InitialMap, offset: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Relative pose of the map's last keyframe to its first: estimated, true."""
    by_stamp = {stamp(i + offset): pose for i, pose in enumerate(path)}
    first, last = initial.keyframes[0], initial.keyframes[-1]
    return (
        poses.inverse(first.world_from_camera) @ last.world_from_camera,
        poses.inverse(by_stamp[first.stamp_ns]) @ by_stamp[last.stamp_ns],
    )


@pytest.mark.parametrize("seed", range(6))
def test_a_general_scene_starts_with_the_right_motion(seed: int) -> None:
    path = sideways(30)
    initial, index, said = run(cloud(seed=seed), path, offset=1000 * seed)
    assert initial is not None, said
    rotation, direction = motion_error(*true_relative(path, initial, 1000 * seed))
    assert rotation < 0.5 and direction < 3.0
    assert index >= 2, "two frames of a slow camera have no parallax yet"


@pytest.mark.parametrize("seed", range(4))
def test_a_third_of_wrong_matches_does_not_matter(seed: int) -> None:
    path = sideways(30)
    initial, _, said = run(cloud(seed=seed), path, FakeMatcher(wrong=0.3), offset=1000 * seed)
    assert initial is not None, said
    rotation, direction = motion_error(*true_relative(path, initial, 1000 * seed))
    assert rotation < 0.5 and direction < 5.0


def test_the_map_is_consistent_and_its_unit_is_the_median_depth() -> None:
    world, path = cloud(seed=1), sideways(30)
    initial, _, _ = run(world, path)
    assert initial is not None
    first = initial.keyframes[0]
    np.testing.assert_allclose(first.world_from_camera, np.eye(4))
    assert np.median(initial.points_world[:, 2]) == pytest.approx(1.0)
    assert initial.map_id == 3
    assert [k.id for k in initial.keyframes] == list(range(7, 7 + len(initial.keyframes)))
    assert len(initial.points_world) >= CONFIG.initialization.min_points
    for keyframe in initial.keyframes:
        seen = np.flatnonzero(keyframe.landmark_ids >= 0)
        assert len(np.unique(keyframe.landmark_ids[seen])) == len(seen)
        predicted = CAMERA.project(poses.apply(poses.inverse(keyframe.world_from_camera), initial.points_world[keyframe.landmark_ids[seen]]))
        error = np.linalg.norm(predicted - keyframe.features.keypoints[seen], axis=1)
        assert np.median(error) < 1.0 and error.max() < 4.0
    # the true structure up to scale, in the first camera's frame
    features = first.features
    seen = np.flatnonzero(first.landmark_ids >= 0)
    true_index = (features.descriptors[seen] @ world.descriptors.T).argmax(axis=1)
    depth = poses.apply(poses.inverse({stamp(i): p for i, p in enumerate(path)}[first.stamp_ns]), world.points[true_index])[:, 2]
    ratio = initial.points_world[first.landmark_ids[seen]][:, 2] / depth
    assert np.percentile(np.abs(ratio / np.median(ratio) - 1), 80) < 0.25


def test_pure_rotation_never_starts_a_map() -> None:
    for seed in range(50):
        rng = np.random.default_rng(seed)
        rates = rng.uniform(-1.5, 1.5, 3)
        path = [look([0, 0, 0], *(rates * i)) for i in range(10)]
        initial, index, said = run(cloud(seed=seed), path, offset=100 * seed, noise_px=float(rng.uniform(0.2, 1.0)))
        assert initial is None, f"seed {seed}: a map at frame {index}"
        assert said[-1]


def test_pure_rotation_with_wrong_matches_never_starts_a_map() -> None:
    for seed in range(8):
        rates = np.random.default_rng(seed).uniform(-1.5, 1.5, 3)
        path = [look([0, 0, 0], *(rates * i)) for i in range(10)]
        for wrong in (0.15, 0.3, 0.45):
            initial, index, _ = run(cloud(seed=seed), path, FakeMatcher(wrong=wrong), offset=100 * seed)
            assert initial is None, f"seed {seed}, {100 * wrong:.0f} % wrong: a map at frame {index}"


def test_a_static_camera_never_starts_a_map() -> None:
    for seed in range(10):
        initial, _, said = run(cloud(seed=seed), [look([0, 0, 0])] * 10, offset=100 * seed, noise_px=0.5)
        assert initial is None
        assert "rotation" in said[-1]


def test_a_noisy_camera_with_a_short_focal_length_that_stands_or_turns_never_starts_a_map() -> None:
    """One pixel of noise at 320x256 looks like a degree of parallax; it is no more than the noise that a start leaves over."""
    camera = CameraModel(np.array([[260.0, 0, 160], [0, 260.0, 128], [0, 0, 1]]), np.zeros(5), DistortionModel.PLUMB_BOB, (320, 256))
    false_starts = []
    for seed in range(8):
        rates = np.random.default_rng(seed).uniform(-1.5, 1.5, 3) * (seed % 2)
        world, initializer = cloud(seed=seed), Initializer(camera, CONFIG, FakeMatcher())
        answers = [
            initializer.add(observe(world, look([0, 0, 0], *(rates * i)), stamp(i + 100 * seed), 1.0, 0.85, 20, camera), None, 0, 0) for i in range(10)
        ]
        false_starts += [seed for answer in answers if isinstance(answer, InitialMap)]
    assert not false_starts


def test_a_static_camera_that_sees_something_move_never_starts_a_map() -> None:
    """A fifth of the points slides sideways past a camera that stands still."""
    world = cloud(seed=2)
    initializer = Initializer(CAMERA, CONFIG, FakeMatcher())
    for index in range(15):
        points = world.points.copy()
        points[::5] += [0.08 * index, 0, 0]
        moving = World(points, world.descriptors, world.scores)
        answer = initializer.add(observe(moving, look([0, 0, 0]), stamp(index), 0.5, 0.9), None, 0, 0)
        assert isinstance(answer, str)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0, 35.0])
def test_a_plane_waits_or_starts_right(tilt_deg: float) -> None:
    """Two views of a plane have two solutions; claiming the wrong one is the failure, waiting is not."""
    started = 0
    for seed in range(5):
        direction = np.random.default_rng(seed).normal(size=3) * [1, 0.5, 0.3]
        direction /= np.linalg.norm(direction)
        path = [look(0.06 * i * direction, 0.3 * i, 0.1 * i) for i in range(20)]
        initial, index, _ = run(plane(seed=seed, tilt_deg=tilt_deg), path, offset=1000 * seed)
        if initial is None:
            continue
        started += 1
        rotation, moved = motion_error(*true_relative(path, initial, 1000 * seed))
        assert rotation < 1.0 and moved < 10.0, f"seed {seed}: wrong map at frame {index} ({rotation:.2f} deg, {moved:.1f} deg)"
    assert started >= 1, "never starting at all would pass the rest of this test"


@pytest.mark.parametrize(("tilt_deg", "seed"), [(20.0, 4), (20.0, 9), (35.0, 7), (20.0, 6), (35.0, 9)])
def test_a_plane_with_wrong_matches_waits_or_starts_right(tilt_deg: float, seed: int) -> None:
    """Frames between reference and current are placed against nearly flat points: a single one placed wrong decides for the wrong motion."""
    direction = np.random.default_rng(seed).normal(size=3) * [1, 0.5, 0.3]
    direction /= np.linalg.norm(direction)
    path = [look(0.06 * i * direction, 0.3 * i, 0.1 * i) for i in range(10)]
    for wrong in (0.1, 0.2):
        initial, index, _ = run(plane(seed=seed, tilt_deg=tilt_deg), path, FakeMatcher(wrong=wrong), offset=1000 * seed, clutter=10)
        if initial is not None:
            rotation, moved = motion_error(*true_relative(path, initial, 1000 * seed))
            assert rotation < 1.0 and moved < 12.0, f"wrong map at frame {index} ({rotation:.2f} deg, {moved:.1f} deg)"


def test_it_says_what_is_missing() -> None:
    initializer = Initializer(CAMERA, CONFIG, FakeMatcher())
    assert "0 keypoints" in str(initializer.add(no_features(stamp(0)), None, 0, 0))
    _, _, said = run(cloud(seed=0), sideways(3, step=0.004))
    assert "parallax" in said[-1] and "move sideways" in said[-1]
    _, _, said = run(cloud(count=60, seed=0), sideways(8), clutter=0)
    assert "matches to the reference frame, 50 needed" in said[-1]


def test_the_reference_advances_when_matches_run_out() -> None:
    """A camera that turns away sees nothing of the first frame after a while; the reference must follow, and a map still start afterwards."""
    world = cloud(count=4000, seed=4, low=(-9, -3, -9), high=(9, 3, 9))
    far = np.linalg.norm(world.points[:, [0, 2]], axis=1) > 3
    world = World(world.points[far], world.descriptors[far], world.scores[far])
    initializer = Initializer(CAMERA, CONFIG, FakeMatcher())
    references = set()
    turning = [look([0, 0, 0], 3.0 * i) for i in range(40)]
    for index, pose in enumerate(turning):
        answer = initializer.add(observe(world, pose, stamp(index), 0.5), None, 0, 0)
        assert isinstance(answer, str)
        assert initializer.reference_features is not None
        references.add(initializer.reference_features.stamp_ns)
    assert len(references) > 1
    assert max(references) >= stamp(20)
    for index in range(40, 70):
        answer = initializer.add(observe(world, look([0.05 * (index - 40), 0, 0], 120.0), stamp(index), 0.5), None, 0, 0)
        if isinstance(answer, InitialMap):
            break
    assert isinstance(answer, InitialMap)


def test_the_window_of_a_camera_that_waits_stays_bounded() -> None:
    initializer = Initializer(CAMERA, CONFIG, FakeMatcher())
    world = cloud(count=120, seed=5)
    reference = []
    for index in range(3 * CONFIG.initialization.max_gap_frames):
        initializer.add(observe(world, look([0, 0, 0]), stamp(index)), None, 0, 0)
        assert initializer.reference_features is not None
        reference.append(initializer.reference_features.stamp_ns)
        assert stamp(index) - reference[-1] <= (CONFIG.initialization.max_gap_frames + 1) * (stamp(1) - stamp(0))


def test_one_blind_frame_does_not_lose_the_reference() -> None:
    """Paper: the reference advances when matches are few *and* the gap is long."""
    initializer = Initializer(CAMERA, CONFIG, FakeMatcher())
    world, path = cloud(seed=6), sideways(8, step=0.01)
    for index, pose in enumerate(path):
        initializer.add(no_features(stamp(index)) if index == 5 else observe(world, pose, stamp(index), 0.5), None, 0, 0)
    assert initializer.reference_features is not None
    assert initializer.reference_features.stamp_ns == stamp(0)


def test_matches_of_the_front_end_are_used_only_if_they_are_to_the_reference() -> None:
    matcher = FakeMatcher()
    initializer = Initializer(CAMERA, CONFIG, matcher)
    world, path = cloud(seed=7), sideways(6, step=0.001)
    frames = [observe(world, pose, stamp(i)) for i, pose in enumerate(path)]
    initializer.add(frames[0], None, 0, 0)
    given = FakeMatcher().match(frames[1], frames[0])
    initializer.add(frames[1], given, 0, 0)
    assert matcher.calls == 0
    initializer.add(frames[2], FakeMatcher().match(frames[2], frames[1]), 0, 0)
    assert matcher.calls >= 1


def test_the_same_frames_start_the_same_map() -> None:
    maps = [run(cloud(seed=8), sideways(30), FakeMatcher(wrong=0.2))[0] for _ in range(2)]
    assert maps[0] is not None and maps[1] is not None
    assert maps[0].points_world.tobytes() == maps[1].points_world.tobytes()
    assert [k.world_from_camera.tobytes() for k in maps[0].keyframes] == [k.world_from_camera.tobytes() for k in maps[1].keyframes]


@pytest.mark.parametrize("noise_px", [0.3, 1.0, 2.0])
def test_parallax_over_noise_is_about_one_for_a_turn_at_any_noise(noise_px: float) -> None:
    rng = np.random.default_rng(0)
    x0 = rng.uniform(-0.5, 0.5, (2000, 2))
    x1 = x0 + rng.normal(0, noise_px / 520, x0.shape)
    any_motion = [MotionHypothesis(poses.transform(np.eye(3), t), "essential") for t in ([1.0, 0, 0], [0, 1.0, 0])]
    flow, ratio = parallax_to_noise(x0, x1, 520.0, any_motion)
    assert flow == pytest.approx(1.177 * noise_px, rel=0.1)
    # the Sampson distance of equal noise in both views is that of one view over the square root of 2
    assert 0.8 < ratio < 1.7
    moved = x1 + np.stack([rng.uniform(20, 60, 2000) / 520, np.zeros(2000)], axis=1)
    assert parallax_to_noise(x0, moved, 520.0, any_motion)[1] > 3.5


def test_the_true_motion_over_a_plane_is_among_the_hypotheses() -> None:
    rng = np.random.default_rng(1)
    points = plane(count=200, seed=1, tilt_deg=20).points
    for camera1 in (look([0.6, 0.1, 0.0], -3.0), look([0.1, 0.0, 0.6]), look([0.3, -0.3, -0.3], 0, 2)):
        motion = poses.inverse(camera1)
        moved = poses.apply(motion, points)
        x0, x1 = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
        found = motion_hypotheses(x0, x1 + rng.normal(0, 0.2 / 520, x1.shape), 520.0, InitializationConfig(), rng)
        assert min(max(motion_error(h.camera1_from_camera0, motion)) for h in found if h.model == "homography") < 2.0
        assert all(np.linalg.norm(h.camera1_from_camera0[:3, 3]) == pytest.approx(1.0) for h in found)


def test_frames_between_are_placed_under_the_true_motion_whatever_was_matched_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each view must explain its right matches to about their noise once everything is adjusted; else the true motion looks worse than a plane's false one."""
    tried: list[tuple[first_map.TrackTable, np.ndarray]] = []
    solve = first_map.solve_first_map

    def note(table: first_map.TrackTable, motion: np.ndarray, model: str, config: ThegraConfig) -> first_map.FirstMap | None:
        tried.append((table, motion))
        return solve(table, motion, model, config)

    monkeypatch.setattr(initializer_module, "solve_first_map", note)
    medians = []
    for tilt_deg, seed in ((20.0, 9), (35.0, 7), (20.0, 4)):
        direction = np.random.default_rng(seed).normal(size=3) * [1, 0.5, 0.3]
        direction /= np.linalg.norm(direction)
        path = [look(0.06 * i * direction, 0.3 * i, 0.1 * i) for i in range(10)]
        initializer = Initializer(CAMERA, CONFIG, FakeMatcher(0.1))
        for index, pose in enumerate(path):
            tried.clear()
            answer = initializer.add(observe(plane(seed=seed, tilt_deg=tilt_deg), pose, stamp(index + 1000 * seed), 0.3, 0.9, 10), None, 0, 0)
            true = poses.inverse(pose) @ path[0]
            for table, motion in tried:
                solved = solve(table, motion, "", CONFIG) if max(motion_error(motion, true)) < 5 and index >= 4 else None
                if solved is not None:
                    cameras = [poses.inverse(camera) for camera in solved.world_from_camera]
                    errors = [table.focal * triangulation.reprojection_errors(c, solved.points_world[solved.good], x[solved.good])
                              for c, x in zip(cameras, table.normalized, strict=True)]  # fmt: skip
                    medians += [float(np.nanmedian(e)) for e in errors]
            if isinstance(answer, InitialMap):
                break
    assert len(medians) > 20
    assert max(medians) < 0.6, "px; 0.38 where all is well, 1.0 with one view in the wrong place"
