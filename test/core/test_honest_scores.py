"""Coverage beside every error, sparse references, and what is fitted only when asked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.evaluation.fitting import fit_lever_arm, fit_time_offset, with_lever_arm, with_offset
from thegra_core.evaluation.scores import Settings, score_files, score_fitted
from thegra_core.geometry.poses import so3_exp
from thegra_core.outputs.scoring import path_length, score_trajectory
from thegra_core.outputs.trajectory import Trajectory, format_stamp, format_tum, make_trajectory

SECOND = 1_000_000_000
T0 = 1_600_000_000 * SECOND


def body_pose(t: float) -> np.ndarray:
    """A hand-held path: uneven turns about all axes, no symmetry."""
    pose = np.eye(4)
    pose[:3, :3] = so3_exp([0.5 * np.sin(1.1 * t), 0.7 * np.sin(0.7 * t + 1) + 0.1 * t, 0.3 * np.sin(1.9 * t)])
    pose[:3, 3] = 2 * np.sin(0.5 * t), 1.5 * np.cos(0.8 * t) + 0.1 * t, 0.3 * np.sin(1.3 * t)
    return pose


def path(times_s: np.ndarray, offset_s: float = 0.0, arm: np.ndarray | None = None) -> Trajectory:
    """Stamped T0 + times; `arm` moves the poses to a camera on the body."""
    trajectory = make_trajectory((T0 + round((t + offset_s) * SECOND), body_pose(t)) for t in times_s)
    return trajectory if arm is None else with_lever_arm(trajectory, arm)


def as_estimate(trajectory: Trajectory, scale: float = 0.2, sigma: float = 0.0, seed: int = 0) -> Trajectory:
    """As a monocular system would tell it: another world, another scale, noise."""
    rng, turn = np.random.default_rng(seed), so3_exp([0.4, -1.0, 0.7])
    poses = trajectory.poses.copy()
    poses[:, :3, 3] = scale * (poses[:, :3, 3] + rng.normal(0, sigma, (len(poses), 3))) @ turn.T + [1, 2, 3]
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    return Trajectory(trajectory.stamps_ns, poses)


def write(folder: Path, estimate: Trajectory, truth: Trajectory) -> tuple[Path, Path]:
    for name, trajectory in (("estimate.txt", estimate), ("truth.txt", truth)):
        (folder / name).write_text(format_tum(trajectory))
    return folder / "estimate.txt", folder / "truth.txt"


CAMERA = np.arange(0, 20, 0.04)  # 25 Hz
SPARSE = np.arange(-0.1, 20.2, 1 / 6)  # Vicon of the ROVTIO recordings


def test_a_sparse_reference_is_interpolated() -> None:
    estimate = as_estimate(path(CAMERA))
    score, nearest = (score_trajectory(estimate, path(SPARSE), estimate.stamps_ns, max_gap_ns=gap) for gap in (SECOND // 2, 0))
    assert score.pairs == len(CAMERA)
    assert nearest.pairs < len(CAMERA) / 3
    assert score.ate_rmse < 0.02


def test_gaps_of_the_reference_are_not_bridged() -> None:
    estimate, times = as_estimate(path(CAMERA)), SPARSE[(SPARSE < 8) | (SPARSE > 9)]
    score = score_trajectory(estimate, path(times), estimate.stamps_ns)
    before, after = times[times < 8][-1], times[times > 9][0]
    unknown = [t for t in CAMERA if before + 0.02 <= t <= after - 0.02]
    assert score.pairs == len(CAMERA) - len(unknown)
    assert len(unknown) > 25
    assert score.pairs_pct == pytest.approx(100 * score.pairs / score.frames, abs=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_equals_evo_over_the_same_interpolated_reference(seed: int) -> None:
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    estimate, truth = as_estimate(path(CAMERA), sigma=0.05, seed=seed), path(SPARSE)
    seconds, query = ((t.stamps_ns - T0) / SECOND for t in (truth, estimate))
    reference = np.tile(np.eye(4), (len(query), 1, 1))
    reference[:, :3, :3] = Slerp(seconds, Rotation.from_matrix(truth.poses[:, :3, :3]))(query).as_matrix()
    for axis in range(3):
        reference[:, axis, 3] = np.interp(query, seconds, truth.positions[:, axis])
    theirs = PoseTrajectory3D(poses_se3=list(estimate.poses), timestamps=query)
    truth_evo = PoseTrajectory3D(poses_se3=list(reference), timestamps=query)
    theirs.align(truth_evo, correct_scale=True)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth_evo, theirs))
    score = score_trajectory(estimate, truth, estimate.stamps_ns)
    assert score.ate_rmse == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-7)
    assert score.spread == pytest.approx(np.linalg.norm(reference[:, :3, 3].std(axis=0)), rel=1e-9)
    assert score.ate_rel == pytest.approx(score.ate_rmse / score.spread)


def test_what_the_error_is_over_is_told() -> None:
    estimate, half = as_estimate(path(CAMERA)), slice(0, 300)
    score = score_trajectory(Trajectory(estimate.stamps_ns[half], estimate.poses[half]), path(CAMERA), estimate.stamps_ns)
    assert (score.frames, score.pairs, score.tracked_pct, score.pairs_pct) == (500, 300, 60.0, 60.0)
    assert score.time_pct == pytest.approx(100 * 299 / 499, abs=0.01)
    assert score.path_scored == pytest.approx(path_length(path(CAMERA[half]).positions))
    assert score.path_length == pytest.approx(path_length(path(CAMERA).positions))


@pytest.mark.parametrize(("kept", "told"), [(250, True), (249, False)])
def test_no_error_is_told_when_half_of_the_frames_have_no_pose(tmp_path: Path, kept: int, told: bool) -> None:
    estimate = as_estimate(path(CAMERA), sigma=0.05)
    files = write(tmp_path, Trajectory(estimate.stamps_ns[:kept], estimate.poses[:kept]), path(CAMERA))
    figures = json.loads(CliRunner().invoke(app, ["score", *map(str, files), "--json"]).stdout)
    shown = CliRunner().invoke(app, ["score", *map(str, files)], env={"COLUMNS": "160"}).stdout
    assert figures["covered"] is told
    assert ("fewer than 50 % of the frames" in shown) is not told
    assert ("ATE / spread" in shown) is told
    assert "recall" in shown


# ---- fits -------------------------------------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.45, 0.45), st.floats(0.05, 20), st.integers(0, 1000))
def test_a_time_offset_is_found(offset_s: float, scale: float, seed: int) -> None:
    estimate = as_estimate(path(CAMERA), scale, 0.01, seed)
    fit = fit_time_offset(estimate, path(np.arange(-1, 21, 0.05), offset_s))
    assert fit.seconds == pytest.approx(-offset_s, abs=0.003)
    assert fit.correlation > 0.95


def test_no_offset_is_made_up_for_a_camera_that_does_not_turn() -> None:
    times = np.arange(0, 20, 0.1)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = times**1.5
    straight = Trajectory(T0 + np.round(times * 1e9).astype(np.int64), poses)
    fit = fit_time_offset(as_estimate(straight), straight)
    assert fit.seconds is None
    assert "too little rotation" in fit.reason


def test_an_offset_beyond_the_bound_is_refused() -> None:
    fit = fit_time_offset(as_estimate(path(CAMERA)), path(np.arange(-2, 22, 0.05), 0.7))
    assert fit.seconds is None


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=3), st.floats(0.05, 20))
def test_a_lever_arm_is_found(arm: list[float], scale: float) -> None:
    estimate = as_estimate(path(CAMERA, arm=np.array(arm)), scale)
    fit = fit_lever_arm(score_trajectory(estimate, path(CAMERA)), estimate)
    np.testing.assert_allclose(fit.body, arm, atol=1e-4)


def test_no_lever_arm_is_made_up_without_rotation() -> None:
    fixed = path(CAMERA)
    fixed.poses[:, :3, :3] = np.eye(3)
    estimate = as_estimate(path(CAMERA, arm=np.array([0.2, 0.0, 0.1])))
    fit = fit_lever_arm(score_trajectory(estimate, fixed), estimate)
    assert fit.body is None
    assert "turns by 0.0 deg" in fit.reason


def test_both_fits_take_the_error_out_and_say_so(tmp_path: Path) -> None:
    arm = np.array([0.1, -0.2, 0.15])
    estimate, truth = as_estimate(path(CAMERA, arm=arm)), path(np.arange(-1, 21, 0.02), 0.21)
    files = write(tmp_path, estimate, truth)
    images = tmp_path / "images.txt"
    images.write_text("".join(f"{format_stamp(stamp)} x.png\n" for stamp in estimate.stamps_ns.tolist()))
    plain = score_files(*files, images, settings=Settings())
    assert "lever_arm" not in plain.as_dict()
    options = ["--images", str(images), "--fit-lever-arm", "--fit-time-offset"]
    figures = json.loads(CliRunner().invoke(app, ["score", *map(str, files), *options, "--json"]).stdout)
    assert figures["time_offset_s"] == pytest.approx(-0.21, abs=0.002)
    np.testing.assert_allclose(figures["lever_arm"], arm, atol=0.01)
    assert figures["ate_rmse"] < 0.01 < figures["ate_rmse_unfitted"] == pytest.approx(plain.absolute.ate_rmse)
    shown = CliRunner().invoke(app, ["score", *map(str, files), *options], env={"COLUMNS": "160"}).stdout
    for text in ("added to the reference's stamps (fitted", "in the body's frame (fitted)", "ATE without the fits"):
        assert text in shown


def test_a_fit_that_cannot_be_made_leaves_the_score_as_it_is() -> None:
    times = np.arange(0, 5, 0.1)
    straight = path(times)
    straight.poses[:, :3, :3] = np.eye(3)
    estimate = as_estimate(straight, sigma=0.05)
    plain, asked = (score_fitted(estimate, straight, None, (), Settings(fit_lever_arm=fit, fit_time_offset=fit)) for fit in (False, True))
    assert asked.absolute.ate_rmse == plain.absolute.ate_rmse == asked.unfitted
    assert asked.time_offset.reason and asked.lever_arm.reason


def test_moving_a_reference_keeps_its_stamps_exact() -> None:
    assert (with_offset(path(CAMERA), 0.1234).stamps_ns - path(CAMERA).stamps_ns == 123_400_000).all()
