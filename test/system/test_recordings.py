"""The whole system through its command: real and simulated recordings against what it must reach, and the same bytes for the same input."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from thegra_core.config import load_config
from thegra_core.errors import WeightsError
from thegra_core.evaluation.benchmark.slam import Plan, execute, planned_runs
from thegra_core.features.registry import weights_for
from thegra_core.features.weights import path_of
from thegra_core.simulation.simulate import SimulationOptions, simulate

MAX_MEMORY_MB = 2500
PATIENCE_S = 3600
SHORT = 0.5
"""Extent in median depths: the hover's 60 m."""


def missing_weights(profile: str) -> str:
    """What to type to get the profile's weights; empty if they are there."""
    config = load_config(profile)
    try:
        for name in weights_for(config.extractor, config.matcher):
            path_of(name)
    except WeightsError as error:
        return str(error)
    return ""


def needs(recording: Path, profile: str) -> None:
    """Skip, and say why, where the recording or the profile's weights are not there."""
    if not recording.is_dir():
        pytest.skip(f"no recording {recording}")
    missing = missing_weights(profile)
    if missing:
        pytest.skip(f"no weights of profile {profile}: {missing}")


def figures(recording: Path, out: Path, max_frames: int | None = None, profile: str = "quality") -> dict[str, Any]:
    """Figures of one run with seed 0."""
    needs(recording, profile)
    limits = {recording.name: max_frames} if max_frames is not None else {}
    plan = Plan((recording,), out, (profile,), max_frames=limits)
    (run,) = planned_runs(plan)
    result = execute(run, plan)
    assert result.error is None
    assert result.figures["peak_mb"] < MAX_MEMORY_MB
    return dict(result.figures)


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize(
    ("profile", "name", "tracked_pct", "ate_rmse"),
    [
        ("quality", "kitchen_rgb_7scenes", 95, 0.03),
        ("quality", "sim_corridor_loop", 97, 0.12),
        ("quality", "sim_room_shutter", 97, 0.05),
        ("quality", "forest_f6_line1", 93, 0.25),
        ("quality", "forest_f0", 90, 0.3),
        ("quality", "orchard_m2ea_drone", 90, 6.0),  # there and back over the ground, with turns of 90 degrees between two frames
        ("paper", "kitchen_rgb_7scenes", 95, 0.045),
        ("paper", "sim_room_shutter", 97, 0.06),
        ("paper", "forest_f6_line1", 93, 0.3),
        ("paper", "forest_f0", 90, 0.3),
        ("realtime", "kitchen_rgb_7scenes", 95, 0.045),
        ("realtime", "sim_corridor_loop", 97, 0.25),
        ("realtime", "sim_room_shutter", 97, 0.05),
    ],
)
def test_it_tracks(shared_data: Path, tmp_path: Path, profile: str, name: str, tracked_pct: float, ate_rmse: float) -> None:
    reached = figures(shared_data / name, tmp_path, profile=profile)
    assert reached["tracked_pct"] >= tracked_pct
    assert reached["ate_rmse"] <= ate_rmse
    assert reached["in_closure"] == 0, "no pose is claimed while the shutter is closed"


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
def test_a_closed_shutter_may_leave_a_gap_instead_of_frozen_frames(shared_data: Path, tmp_path: Path) -> None:
    whole, cut = shared_data / "sim_room_shutter", tmp_path / "cut"
    needs(whole, "quality")
    cut.mkdir()
    for name in ("images", "camera.yaml", "groundtruth.txt", "shutter.txt"):
        (cut / name).symlink_to(whole / name)
    closures = [tuple(map(float, line.split())) for line in (whole / "shutter.txt").read_text().splitlines() if line.strip()]
    lines = (whole / "images.txt").read_text().splitlines(keepends=True)
    kept = [line for line in lines if line.startswith("#") or not any(begin <= float(line.split()[0]) < end for begin, end in closures)]
    assert len(kept) < len(lines)
    (cut / "images.txt").write_text("".join(kept))
    reached = figures(cut, tmp_path / "out")
    assert reached["maps"] == 1
    assert reached["tracked_pct"] >= 97
    assert reached["ate_rmse"] <= 0.06
    assert len(reached["shutter_closures"]) == len(closures)


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
def test_a_plane_from_above_is_tracked_or_left_alone(shared_data: Path, tmp_path: Path) -> None:
    reached = figures(shared_data / "orchard_m2ea_drone", tmp_path, max_frames=15)
    if reached["maps"] > 0:
        assert reached["tracked_pct"] >= 80
        assert reached["ate_rmse"] <= 4


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize("profile", ["quality", "realtime"])
@pytest.mark.parametrize("name", ["sim_rotation_only", "neg_hover_static_hit"])
def test_a_camera_that_stays_in_place_starts_no_map(shared_data: Path, tmp_path: Path, name: str, profile: str) -> None:
    reached = figures(shared_data / name, tmp_path, profile=profile)
    assert (reached["maps"], reached["poses"]) == (0, 0)


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize("profile", ["quality", "realtime"])
def test_a_hovering_camera_that_pans_claims_no_journey(shared_data: Path, tmp_path: Path, profile: str) -> None:
    assert figures(shared_data / "neg_hover_pan_hit", tmp_path, profile=profile)["extent"] < SHORT


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize(("scene", "shutter", "ate_rmse"), [("room", "freeze", 0.15), ("tunnel", "gap", 0.25)])
def test_simulated_scenes_are_tracked(tmp_path: Path, scene: Any, shutter: Any, ate_rmse: float) -> None:
    options = SimulationOptions(scene=scene, shutter=shutter, duration_s=12, image_size=(320, 256))
    reached = figures(simulate(options, tmp_path / scene, "folder"), tmp_path / "out", profile="fast")
    assert reached["tracked_pct"] >= 95
    assert reached["ate_rmse"] <= ate_rmse
    assert reached["in_closure"] == 0, "no pose is claimed while the shutter is closed"


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
def test_a_long_corridor_closes_its_loop(tmp_path: Path) -> None:
    """Once round and on, 71 m: what has drifted is set right where the way began."""
    options = SimulationOptions(scene="corridor", duration_s=71.6, rate_hz=5, image_size=(320, 256), seed=210)
    reached = figures(simulate(options, tmp_path / "corridor", "folder"), tmp_path / "out")
    assert reached["tracked_pct"] >= 97
    assert reached["loops"] >= 1
    assert reached["ate_pct"] <= 0.3


@pytest.mark.parametrize("profile", ["fast", "realtime"])
def test_same_input_same_bytes(tmp_path: Path, profile: str) -> None:
    """Run again, and with a cache of the networks' results."""
    bag = simulate(SimulationOptions(style="aggressive", duration_s=1.5, image_size=(320, 256)), tmp_path / "bag")
    extractor = "orb" if missing_weights(profile) else "xfeat"
    outs = [tmp_path / "first", tmp_path / "second", tmp_path / "cached"]
    for out in outs:
        cache = ["--cache", tmp_path / "cache"] if out.name == "cached" else []
        command = ["run", bag, "--profile", profile, "--set", f"extractor.name={extractor}", "--out", out, "--quiet", *cache]
        subprocess.run([sys.executable, "-m", "thegra_core.cli.main", *map(str, command)], check=True, capture_output=True)
    first, second, cached = ((out / "trajectory.txt").read_bytes() for out in outs)
    assert first == second == cached
    assert first.count(b"\n") >= 5, "bytes of nothing say nothing"
