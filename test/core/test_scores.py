from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_runs import BEGIN_NS, PERIOD_NS, true_pose

from thegra_core.errors import InputError
from thegra_core.evaluation.scores import read_intervals, read_stamps, relative_error, score_files
from thegra_core.geometry.poses import so3_exp
from thegra_core.outputs.scoring import UNMATCHED, align, half_period, nearest, path_length, score_trajectory
from thegra_core.outputs.trajectory import Trajectory, format_tum, make_trajectory


def truth(count: int = 30) -> Trajectory:
    return make_trajectory((BEGIN_NS + i * PERIOD_NS, true_pose(i)) for i in range(count))


def noisy(count: int = 30, sigma: float = 0.05, scale: float = 0.3, seed: int = 0, keep: slice = slice(None), jitter: float = 0.0) -> Trajectory:
    """The truth turned, scaled, moved and shaken, with stamps off by up to `jitter` periods."""
    rng = np.random.default_rng(seed)
    turn, poses = so3_exp([0.3, -0.7, 1.1]), []
    for i in range(count):
        pose = true_pose(i)
        pose[:3, :3] = turn @ pose[:3, :3] @ so3_exp(rng.normal(0, sigma / 5, 3))
        pose[:3, 3] = scale * (turn @ (pose[:3, 3] + rng.normal(0, sigma, 3))) + [5, -3, 2]
        poses.append((BEGIN_NS + i * PERIOD_NS + round(rng.uniform(-jitter, jitter) * PERIOD_NS), pose))
    return make_trajectory(poses[keep])


def test_hand_computed_error() -> None:
    """A square of side 2 whose corners are off by 0.1 along z with alternating signs: no alignment can take that out."""
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], float)
    off = corners + np.array([[0, 0, 0.1], [0, 0, -0.1], [0, 0, 0.1], [0, 0, -0.1]])
    score = score_trajectory(_straight(off), _straight(corners))
    # scale s minimises 4 * ((1 - s)^2 * 2 + s^2 * 0.01), so s = 2 / 2.01
    s = 2 / 2.01
    assert score.scale == pytest.approx(s, rel=1e-12)
    assert score.ate_rmse == pytest.approx(np.sqrt(2 * (1 - s) ** 2 + 0.01 * s**2), rel=1e-9)
    assert score.path_length == pytest.approx(6)
    assert score.ate_pct == pytest.approx(100 * score.ate_rmse / 6)
    assert score.ate_rel == pytest.approx(score.ate_rmse / np.sqrt(2))
    assert (score.frames, score.poses, score.pairs, score.tracked_pct) == (4, 4, 4, 100.0)


def test_a_similar_trajectory_has_no_error() -> None:
    score = score_trajectory(noisy(sigma=0), truth())
    assert score.ate_rmse == pytest.approx(0, abs=1e-9)
    assert score.scale == pytest.approx(1 / 0.3)
    assert score.rot_deg == pytest.approx(0, abs=1e-5)
    assert score.recall_1pct == 100.0


def test_a_mirrored_trajectory_is_not_aligned_away() -> None:
    mirrored = [(int(stamp), pose) for stamp, pose in zip(truth().stamps_ns, truth().poses * np.array([[1, 1, 1, -1]] + [[1] * 4] * 3), strict=True)]
    assert score_trajectory(make_trajectory(mirrored), truth()).ate_rmse > 0.2


def test_missing_poses_lower_coverage_but_not_accuracy() -> None:
    full, half = score_trajectory(noisy(sigma=0), truth()), score_trajectory(noisy(sigma=0, keep=slice(0, 15)), truth())
    assert (full.tracked_pct, half.tracked_pct) == (100.0, 50.0)
    assert half.ate_rmse == pytest.approx(0, abs=1e-9)
    assert half.recall_1pct == 50.0  # a missing pose is a miss
    assert half.path_length == full.path_length


@pytest.mark.parametrize("poses", [0, 1, 2])
def test_fewer_than_three_pairs_have_no_error(poses: int) -> None:
    score = score_trajectory(noisy(keep=slice(0, poses)), truth())
    assert (score.pairs, score.ate_rmse, score.ate_rel, score.scale, score.rot_deg) == (poses, None, None, None, None)
    assert score.tracked_pct == pytest.approx(100 * poses / 30, abs=0.01)
    assert relative_error(score, noisy(keep=slice(0, poses))) is None


def test_a_camera_that_stood_still_keeps_the_truths_spread_as_error() -> None:
    still = make_trajectory((BEGIN_NS + i * PERIOD_NS, np.eye(4)) for i in range(30))
    score = score_trajectory(still, truth())
    assert score.ate_rel == pytest.approx(1)
    assert np.isfinite(score.scale)


def test_truth_that_stands_still_gives_no_relative_figures() -> None:
    still = make_trajectory((BEGIN_NS + i * PERIOD_NS, np.eye(4)) for i in range(30))
    score = score_trajectory(noisy(), still)
    assert score.ate_pct is None
    assert score.ate_rel is None


def test_nearest_prefers_the_earlier_at_a_tie_and_respects_the_tolerance() -> None:
    stamps = np.array([10, 20, 40])
    assert nearest(stamps, np.array([0, 14, 15, 16, 29, 31, 46, 100]), 10).tolist() == [0, 0, 0, 1, 1, 2, 2, UNMATCHED]
    assert nearest(stamps, np.array([15]), 4).tolist() == [UNMATCHED]
    assert nearest(stamps[:0], np.array([1, 2]), 10).tolist() == [UNMATCHED, UNMATCHED]
    assert nearest(stamps[:1], np.array([5, 30]), 10).tolist() == [0, UNMATCHED]


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True), st.lists(st.integers(-100, 1100), max_size=20), st.integers(0, 200))
def test_nearest_is_the_nearest(stamps: list[int], queries: list[int], tolerance: int) -> None:
    ordered = np.array(sorted(stamps))
    for query, index in zip(queries, nearest(ordered, np.array(queries, np.int64), tolerance), strict=True):
        best = np.abs(ordered - query).min()
        assert (index == UNMATCHED) == (best > tolerance)
        assert index == UNMATCHED or abs(ordered[index] - query) == best


def test_half_a_period_is_a_little_less() -> None:
    assert half_period(np.arange(5) * 1000) == 499
    assert half_period(np.array([7])) == 0


def test_path_length_of_a_square() -> None:
    assert path_length(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]], float)) == 4


def test_closures_are_not_scored_but_claims_in_them_are_counted() -> None:
    estimate = noisy(sigma=0)
    estimate.poses[10:13, :3, 3] += 100
    closure = (BEGIN_NS + 10 * PERIOD_NS, BEGIN_NS + 13 * PERIOD_NS)
    score = score_trajectory(estimate, truth(), closures_ns=[closure])
    assert (score.frames, score.in_closure, score.pairs) == (27, 3, 27)
    assert score.ate_rmse == pytest.approx(0, abs=1e-9)


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.floats(0.01, 100))
def test_alignment_is_found_again(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points, rotation, translation = rng.normal(size=(10, 3)), so3_exp(rng.normal(size=3)), rng.normal(size=3)
    alignment = align(points, scale * points @ rotation.T + translation)
    assert alignment.scale == pytest.approx(scale)
    np.testing.assert_allclose(alignment.rotation, rotation, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_evo(seed: int) -> None:
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
        return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamps_ns / 1e9)

    estimate, groundtruth = noisy(seed=seed, keep=slice(2, 27), jitter=0.1), truth()
    reference, aligned = sync.associate_trajectories(as_evo(groundtruth), as_evo(estimate), max_diff=0.05)
    aligned.align(reference, correct_scale=True)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    score = score_trajectory(estimate, groundtruth, max_gap_ns=0)
    assert score.pairs == 25
    assert score.ate_rmse == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    assert score.ate_max == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), rel=1e-9)

    relative = relative_error(score, estimate)
    for relation, ours in ((metrics.PoseRelation.translation_part, relative.trans_rmse), (metrics.PoseRelation.rotation_angle_deg, relative.rot_rmse_deg)):
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
        rpe.process_data((reference, aligned))
        assert ours == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


def test_files_with_lists_of_frames_and_closures(tmp_path: Path) -> None:
    _write(tmp_path)
    (tmp_path / "images.txt").write_text("# t path\n" + "".join(f"{BEGIN_NS // 10**9 + i * 0.1:.6f} images/{i}.png\n" for i in range(40)))
    (tmp_path / "shutter.txt").write_text(f"{BEGIN_NS // 10**9 + 1:.6f} {BEGIN_NS // 10**9 + 1.3:.6f}\n")
    figures = score_files(tmp_path / "estimate.txt", tmp_path / "truth.txt", tmp_path / "images.txt", tmp_path / "shutter.txt").as_dict()
    assert (figures["frames"], figures["pairs"], figures["in_closure"]) == (37, 27, 3)
    assert figures["tracked_pct"] == pytest.approx(100 * 27 / 37, abs=0.01)
    assert figures["rpe_trans_rmse"] > 0
    json.dumps(figures, allow_nan=False)


def test_lists_of_images_have_seconds_or_nanoseconds(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1700000000.5 b.png\n1700000000250000000,a.png\n")
    assert read_stamps(tmp_path / "a.txt").tolist() == [1_700_000_000_250_000_000, 1_700_000_000_500_000_000]


def test_bad_lists_are_named_by_line(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1.0 2.0\nx y\n")
    for read in (read_stamps, read_intervals):
        with pytest.raises(InputError, match=r"a.txt:2: expected"):
            read(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("1.0\n")
    with pytest.raises(InputError, match=r"a.txt:1: expected `begin end`"):
        read_intervals(tmp_path / "a.txt")
    with pytest.raises(InputError, match="cannot read"):
        read_stamps(tmp_path / "absent.txt")


def test_ground_truth_without_poses_is_refused(tmp_path: Path) -> None:
    _write(tmp_path)
    (tmp_path / "truth.txt").write_text("# empty\n")
    with pytest.raises(InputError, match="holds no poses"):
        score_files(tmp_path / "estimate.txt", tmp_path / "truth.txt")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # the scorer leaves its files open
@pytest.mark.parametrize("sequence", ["kitchen_rgb_7scenes", "sim_room_shutter", "forest_f0"])
def test_agrees_with_the_independent_scorer(shared_data: Path, tmp_path: Path, sequence: str) -> None:
    scorer = shared_data.parent / "tools" / "score.py"
    if not scorer.is_file():
        pytest.skip(f"no {scorer}")
    spec = importlib.util.spec_from_file_location("independent_score", scorer)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    folder = shared_data / sequence
    rng = np.random.default_rng(1)
    rows = np.loadtxt(folder / "groundtruth.txt")[3:-2]
    rows[:, 1:4] = 0.4 * rows[:, 1:4] + rng.normal(0, 0.02, (len(rows), 3))
    np.savetxt(tmp_path / "estimate.txt", rows, fmt="%.9f")
    shutter = folder / "shutter.txt" if (folder / "shutter.txt").is_file() else None
    theirs = module.score(tmp_path / "estimate.txt", folder / "groundtruth.txt", folder / "images.txt", None, shutter)
    ours = score_files(tmp_path / "estimate.txt", folder / "groundtruth.txt", folder / "images.txt", shutter).as_dict()
    for key, value in theirs.items():
        assert ours[key] == pytest.approx(value, rel=1e-6, abs=1e-4), key


def _straight(positions: np.ndarray) -> Trajectory:
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return make_trajectory((BEGIN_NS + i * PERIOD_NS, pose) for i, pose in enumerate(poses))


def _write(folder: Path) -> None:
    (folder / "estimate.txt").write_text(format_tum(noisy()))
    (folder / "truth.txt").write_text(format_tum(truth()))
