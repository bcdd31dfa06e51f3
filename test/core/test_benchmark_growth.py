"""The benchmark of a growing map: its street, its figures and its files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.evaluation.benchmark.growth import Sample, summary
from thegra_core.geometry import poses
from thegra_core.simulation.points import CAMERA, NOISE_PX, EqualDescriptors, PointStreet


def test_a_frame_of_the_street_is_its_points_seen_from_there() -> None:
    street = PointStreet(frames=200, keypoints=300)
    seen = street.see(120, 5)
    assert 200 < len(seen) < 400 and seen.stamp_ns == 5
    point = np.argmax(seen.descriptors @ street.descriptors.T, axis=1)
    pixels = CAMERA.project(poses.apply(poses.inverse(street.world_from_camera(120)), street.points[point]))
    assert np.abs(pixels - seen.keypoints).max() < 6 * NOISE_PX
    np.testing.assert_array_equal(seen.keypoints, street.see(120, 5).keypoints)
    assert len(street.see(0, 0)) > 200 and len(street.see(199, 0)) > 200, "the street does not end before the way does"
    matches = EqualDescriptors().match(seen, street.see(124, 6))
    assert len(matches) > 150 and (point[matches.indices[:, 0]] == np.argmax(street.see(124, 6).descriptors @ street.descriptors.T, axis=1)[matches.indices[:, 1]]).all()


def test_summary_by_hand() -> None:
    """A hundred frames, every other a keyframe; costs double over the run."""
    samples = [Sample(100.0 + i if i % 2 else 10.0 + 0.1 * i, i % 2 == 1, i >= 4, i // 2, 10 * i, 200.0 + i) for i in range(100)]
    told = summary(samples)
    assert told["frame_cpu_ms"] == [pytest.approx(11.4), pytest.approx(19.4)]
    assert told["keyframe_cpu_ms"] == [115.0, 195.0] and told["keyframe_growth"] == pytest.approx(195 / 115, abs=1e-3)
    assert (told["frames"], told["tracked_pct"], told["keyframes"]) == (100, 96.0, [9, 49])
    assert told["mb_per_keyframe"] == pytest.approx(80 / 40)


def test_the_command_writes_its_figures(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["benchmark", "growth", "--minutes", "0.1", "--keypoints", "200", "--out", str(tmp_path), "--json", "--set", "mapping.redundant_from=20"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    written = json.loads((tmp_path / "growth.json").read_text(encoding="utf-8"))
    assert written["summary"] == told and len(written["frames"]["cpu_ms"]) == told["frames"] == 60
    assert told["tracked_pct"] > 80 and told["keyframes"][1] > told["keyframes"][0] > 0
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")
    wrong = CliRunner().invoke(app, ["benchmark", "growth", "--set", "nothing"])
    assert wrong.exit_code != 0
