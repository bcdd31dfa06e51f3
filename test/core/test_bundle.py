"""Bundle adjustment against the cost written out by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thegra_core.geometry import poses
from thegra_core.optimization import bundle
from thegra_core.optimization.bundle import MINIMIZERS, BundleProblem, BundleResult, squared_errors

FOCAL, HUBER, CHI2 = 400.0, 2.447, 5.991


@pytest.fixture(params=sorted(MINIMIZERS), autouse=True)
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Every test holds for each solver."""
    monkeypatch.setattr(bundle_adjust, "solver", request.param, raising=False)
    return str(request.param)


def bundle_adjust(task: BundleProblem, huber_px: float, chi2_px2: float, iterations: int, **settings: Any) -> BundleResult:
    return bundle.bundle_adjust(task, huber_px, chi2_px2, iterations, solver=bundle_adjust.solver, **settings)  # type: ignore[attr-defined]


def problem(seed: int = 0, views: int = 4, count: int = 40, noise_px: float = 0.5, fixed: int = 1, start: float = 0.01, weights: str = "grid") -> BundleProblem:
    """Views in an arc around random points; a start disturbed by `start`; weights on the grid the factors are made for, or uniform."""
    rng = np.random.default_rng(seed)
    cameras = np.stack([poses.transform(Rotation.from_rotvec([0, -0.08 * i, 0.02 * i]).as_matrix(), [0.4 * i, 0.05 * i * i, -0.03 * i]) for i in range(views)])
    points = rng.uniform([-2, -2, 4], [2, 2, 8], (count, 3))
    view, point = (a.ravel() for a in np.meshgrid(np.arange(views), np.arange(count), indexing="ij"))
    camera_points = np.stack([poses.apply(poses.inverse(c), points) for c in cameras])[view, point]
    weight = 2.0 ** rng.choice([-2.0, -0.75, 0.0, 0.5, 2.0], len(view)) if weights == "grid" else np.ones(len(view))
    normalized = camera_points[:, :2] / camera_points[:, 2:] + rng.normal(0, noise_px / FOCAL, (len(view), 2)) / np.sqrt(weight)[:, None]
    held = np.arange(views) < fixed
    disturbed = cameras.copy()
    for i in np.flatnonzero(~held):
        disturbed[i] = cameras[i] @ poses.transform(poses.so3_exp(rng.normal(0, start / 5, 3)), rng.normal(0, start, 3))
    return BundleProblem(disturbed, held, points + rng.normal(0, start, points.shape), view, point, normalized, weight, FOCAL)


def cost(task: BundleProblem, cameras: np.ndarray, points: np.ndarray, used: np.ndarray) -> float:
    """Sum of Huber(sqrt(e^T Omega e)): d^2 / 2 up to k, k (d - k / 2) beyond (gtsam's convention)."""
    d = np.sqrt(task.weights * squared_errors(task, cameras, points))[used]
    return float(np.where(d <= HUBER, d**2 / 2, HUBER * (d - HUBER / 2)).sum())


def test_squared_errors_by_hand() -> None:
    camera = poses.transform(np.eye(3), [1.0, 0, 0])  # the point (1, 0, 2) is straight ahead
    task = BundleProblem(camera[None], np.array([True]), np.array([[1.0, 0, 2], [1, 0, -2]]), np.array([0, 0]), np.array([0, 1]),
                         np.array([[0.003, 0.004], [0, 0]]), np.ones(2), 1000.0)  # fmt: skip
    np.testing.assert_allclose(squared_errors(task, task.world_from_camera, task.points_world), [25.0, np.inf])


def test_exact_observations_give_the_exact_scene() -> None:
    task, exact = problem(noise_px=0.0, fixed=2), problem(noise_px=0.0, fixed=2, start=0.0)
    found = bundle_adjust(task, HUBER, CHI2, 30)
    np.testing.assert_allclose(found.world_from_camera, exact.world_from_camera, atol=1e-4)
    np.testing.assert_allclose(found.points_world, exact.points_world, atol=1e-3)
    assert not found.outliers.any()


def test_the_result_is_a_minimum_of_the_weighted_robust_cost() -> None:
    """Moving any free pose or any point a little in any direction costs more; a gate that is wide open keeps all observations in both stages."""
    task = problem(seed=1, fixed=2, noise_px=1.5, count=25)
    found = bundle_adjust(task, HUBER, 1e6, 60)
    used = np.ones(len(task.weights), dtype=bool)
    least = cost(task, found.world_from_camera, found.points_world, used)
    assert least < 0.5 * cost(task, task.world_from_camera, task.points_world, used)
    whitened = np.sqrt(task.weights * squared_errors(task, found.world_from_camera, found.points_world))
    assert (whitened > HUBER).any(), "the linear part of the kernel takes part"
    for row in (2, 3):
        for axis in range(6):
            for sign in (-1, 1):
                delta = np.zeros(6)
                delta[axis] = sign * 2e-3
                cameras = found.world_from_camera.copy()
                cameras[row] = cameras[row] @ poses.transform(poses.so3_exp(delta[:3]), delta[3:])
                assert cost(task, cameras, found.points_world, used) > least
    for row in range(0, 25, 5):
        for step in 0.02 * np.concatenate([np.eye(3), -np.eye(3)]):
            points = found.points_world.copy()
            points[row] += step
            assert cost(task, found.world_from_camera, points, used) > least


def test_weights_matter() -> None:
    """Two halves of the observations contradict each other; the heavy half wins."""
    task = problem(seed=2, fixed=2, noise_px=0.0, weights="uniform")
    shifted = task.normalized.copy()
    odd = task.point_index % 2 == 1
    shifted[(task.keyframe_index == 3) & odd] += [1.0 / FOCAL, 0]
    for heavy in (odd, ~odd):
        weighted = replace(task, normalized=shifted, weights=np.where(heavy, 4.0, 0.25))
        found = bundle_adjust(weighted, HUBER, 1e6, 50)
        errors = found.squared_errors[task.keyframe_index == 3]
        mine = heavy[task.keyframe_index == 3]
        assert np.median(errors[mine]) < np.median(errors[~mine])


def test_weights_between_the_grid_of_the_graph_are_at_most_a_tenth_off() -> None:
    task = problem(seed=3, fixed=2, noise_px=1.0)
    on_grid, beside = (bundle.bundle_adjust(t, HUBER, 1e6, 30, solver="gtsam") for t in (task, replace(task, weights=1.08 * task.weights)))
    np.testing.assert_array_equal(on_grid.world_from_camera, beside.world_from_camera)


def test_fixed_poses_do_not_move_by_a_bit() -> None:
    task = problem(seed=4, fixed=2)
    before = task.world_from_camera.copy(), task.points_world.copy()
    found = bundle_adjust(task, HUBER, CHI2, 10)
    np.testing.assert_array_equal(found.world_from_camera[:2], before[0][:2])
    assert (found.world_from_camera[2:] != before[0][2:]).any()
    np.testing.assert_array_equal(task.world_from_camera, before[0], "the problem itself stays as it was")
    np.testing.assert_array_equal(task.points_world, before[1])


@pytest.mark.parametrize("held", [0, 3])
def test_one_fixed_pose_keeps_the_scale(held: int) -> None:
    task = problem(seed=5, start=0.03)
    task = replace(task, fixed=np.arange(4) == held)
    found = bundle_adjust(task, HUBER, CHI2, 30)
    distance = np.linalg.norm(task.world_from_camera[:, :3, 3] - task.world_from_camera[held, :3, 3], axis=1)
    far = int(np.argmax(distance))
    after = np.linalg.norm(found.world_from_camera[far, :3, 3] - found.world_from_camera[held, :3, 3])
    assert after == pytest.approx(distance[far], rel=1e-9)
    assert not found.outliers.mean() > 0.15


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("start", [0.02, 0.1])
def test_one_fixed_pose_does_not_keep_the_others_from_moving(seed: int, start: float) -> None:
    """Holding the scale must not hold the poses: from a start as bad as a first map's the exact scene is found, up to scale."""
    task = problem(seed=seed, noise_px=0.0, start=start, weights="uniform", count=80)
    found = bundle_adjust(task, HUBER, 1e6, 30)
    assert np.sqrt(found.squared_errors.max()) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_one_fixed_pose_and_wrong_matches(seed: int) -> None:
    """As in a first map: small baseline, a tenth of the observations wrong."""
    task = problem(seed=seed, noise_px=0.3, start=0.05, weights="uniform", count=100, views=5)
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(task.weights)) < 0.1
    normalized = task.normalized.copy()
    normalized[wrong] += rng.uniform(-100, 100, (int(wrong.sum()), 2)) / FOCAL
    found = bundle_adjust(replace(task, normalized=normalized), HUBER, CHI2, 30)
    assert (found.squared_errors[~wrong] < CHI2).mean() > 0.97
    assert np.median(found.squared_errors[~wrong]) < 3 * 0.3**2


def test_outliers_are_marked_exactly() -> None:
    task = problem(seed=6, fixed=2, noise_px=0.1, count=60, weights="uniform")
    rng = np.random.default_rng(0)
    wrong = np.zeros(len(task.weights), dtype=bool)
    wrong[rng.choice(60, 12, replace=False) + 60 * rng.integers(0, 4, 12)] = True  # at most one of a point's four views
    normalized = task.normalized.copy()
    normalized[wrong] += rng.uniform(8, 25, (wrong.sum(), 2)) * rng.choice([-1, 1], (wrong.sum(), 2)) / FOCAL
    found = bundle_adjust(replace(task, normalized=normalized), HUBER, CHI2, 20)
    np.testing.assert_array_equal(found.outliers, wrong)
    np.testing.assert_array_equal(found.squared_errors > CHI2, wrong)


def test_the_outlier_test_is_on_pixels_whatever_the_weights() -> None:
    task = problem(seed=7, fixed=2, noise_px=0.0, weights="uniform")
    normalized = task.normalized.copy()
    normalized[5] += [12.0 / FOCAL, 0]
    for weight in (1.0, 0.01):
        assert bundle_adjust(replace(task, normalized=normalized, weights=np.full(len(task.weights), weight)), HUBER, CHI2, 20).outliers[5]


def test_points_with_one_observation_are_left_alone() -> None:
    task = problem(seed=8, fixed=2)
    keep = ~((task.point_index == 7) & (task.keyframe_index != 2))
    task = replace(task, **{name: getattr(task, name)[keep] for name in ("keyframe_index", "point_index", "normalized", "weights")})
    found = bundle_adjust(task, HUBER, CHI2, 20)
    np.testing.assert_array_equal(found.points_world[7], task.points_world[7])
    assert (found.points_world[6] != task.points_world[6]).any()


def test_poses_and_points_nobody_sees_are_left_alone() -> None:
    task = problem(seed=9, fixed=2)
    task = replace(
        task,
        world_from_camera=np.concatenate([task.world_from_camera, np.eye(4)[None]]),
        fixed=np.append(task.fixed, False),
        points_world=np.concatenate([task.points_world, [[7.0, 8.0, 9.0]]]),
    )
    found = bundle_adjust(task, HUBER, CHI2, 10)
    np.testing.assert_array_equal(found.world_from_camera[-1], np.eye(4))
    np.testing.assert_array_equal(found.points_world[-1], [7, 8, 9])


def test_a_point_behind_the_cameras_is_an_outlier_and_disturbs_nobody() -> None:
    task = problem(seed=10, fixed=2, noise_px=0.0)
    points = task.points_world.copy()
    points[3] = [0, 0, -6]
    found = bundle_adjust(replace(task, points_world=points), HUBER, CHI2, 20)
    np.testing.assert_array_equal(found.outliers, task.point_index == 3)
    assert np.isinf(found.squared_errors[task.point_index == 3]).all()
    np.testing.assert_array_equal(found.points_world[3], points[3])


def test_undefined_observations_are_outliers() -> None:
    task = problem(seed=11, fixed=2, noise_px=0.1)
    normalized = task.normalized.copy()
    normalized[17] = np.nan
    found = bundle_adjust(replace(task, normalized=normalized), HUBER, CHI2, 10)
    assert found.outliers[17] and found.outliers.sum() == 1
    assert np.isfinite(found.world_from_camera).all() and np.isfinite(found.points_world).all()


def test_nothing_free_or_nothing_seen_changes_nothing() -> None:
    task = problem(seed=12, fixed=4)
    found = bundle_adjust(task, HUBER, CHI2, 10)
    np.testing.assert_array_equal(found.points_world, task.points_world)
    empty = replace(task, **{name: getattr(task, name)[:0] for name in ("keyframe_index", "point_index", "normalized", "weights")})
    assert len(bundle_adjust(empty, HUBER, CHI2, 10).outliers) == 0


def test_an_indeterminate_system_returns_the_start() -> None:
    """A free pose that sees a single point has no solution of its own; what comes back is finite and whole."""
    task = problem(seed=13, fixed=2)
    keep = (task.keyframe_index != 3) | (task.point_index == 0)
    task = replace(task, **{name: getattr(task, name)[keep] for name in ("keyframe_index", "point_index", "normalized", "weights")})
    found = bundle_adjust(task, HUBER, CHI2, 10)
    assert np.isfinite(found.world_from_camera).all() and np.isfinite(found.points_world).all()
    np.testing.assert_array_equal(found.world_from_camera[:2], task.world_from_camera[:2])


def test_repetition_gives_the_same_bytes() -> None:
    task = problem(seed=14, views=8, count=200, noise_px=1.0)
    results = [bundle_adjust(task, HUBER, CHI2, 15) for _ in range(3)]
    assert len({r.world_from_camera.tobytes() + r.points_world.tobytes() + r.outliers.tobytes() for r in results}) == 1


def test_the_solvers_agree() -> None:
    """With wrong matches, and weights beside the grid only one of them has: the same observations are outliers, and the scene is the same."""
    task = problem(seed=15, views=8, count=200, noise_px=0.3, fixed=2, start=0.02)
    normalized = task.normalized.copy()
    normalized[::23] += 30 / FOCAL
    by_graph, by_schur = (bundle.bundle_adjust(replace(task, normalized=normalized), HUBER, CHI2, 50, 1e-9, name) for name in ("gtsam", "schur"))
    np.testing.assert_array_equal(by_graph.outliers, by_schur.outliers)
    np.testing.assert_allclose(by_graph.world_from_camera, by_schur.world_from_camera, atol=1e-4)
    np.testing.assert_allclose(by_graph.points_world, by_schur.points_world, atol=2e-3)


def test_landmarks_that_slide_bend_the_map_less() -> None:
    """A third of the landmarks slide steadily from view to view, each its own way, by less than makes an outlier. Weighed by what is left of their errors they
    count for so little that the scene errs by less than half; where none slides that costs nothing."""
    errors = np.array([_slide_errors(seed) for seed in range(6)]).mean(axis=0)
    sliding, sliding_weighed, steady, steady_weighed = errors
    assert sliding_weighed < 0.5 * sliding
    assert steady_weighed < 1.1 * steady < 0.5 * sliding


def _slide_errors(seed: int) -> list[float]:
    """Error of the cameras' positions with landmarks that slide and with steady ones, all alike and weighed."""
    steady = problem(seed, views=10, count=120, noise_px=0.2, fixed=2, weights="uniform")
    exact = problem(seed, views=10, count=120, noise_px=0.0, fixed=2, start=0.0).world_from_camera
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, 120)
    ways = np.where(np.arange(120) % 3 == 0, 0.5 / FOCAL, 0.0)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    slid = np.clip(steady.keyframe_index - 4.5, -4, 4)[:, None] * ways[steady.point_index]
    errors = []
    for task in (replace(steady, normalized=steady.normalized + slid), steady):
        for freedom in (0.0, 4.0):
            found = bundle_adjust(task, HUBER, 1e6, 30, tolerance=1e-6, freedom=freedom, weighings=3)
            errors.append(float(np.linalg.norm(found.world_from_camera[:, :3, 3] - exact[:, :3, 3])))
    return errors
