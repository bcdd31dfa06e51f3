from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from made_runs import FakeSystem, make_run

from thegra_core.errors import ConfigError
from thegra_core.outputs.viewer import NullViewer, RerunViewer, make_viewer


def test_no_viewer_asks_for_nothing() -> None:
    class Untouchable:
        def snapshot(self):
            raise AssertionError("a headless run must not pay for pictures")

        current_map = map_size = snapshot

    run = make_run()
    viewer = make_viewer("none")
    assert isinstance(viewer, NullViewer)
    for frame in run.frames:
        viewer.show(frame.result, Untouchable())
    viewer.finish(run)


def test_unknown_viewers_are_named_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match="'paraview'; known: none, rerun"):
        make_viewer("paraview")


def test_a_missing_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def without_rerun(name: str, *rest):
        if name == "rerun":
            raise ImportError("No module named 'rerun'")
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", without_rerun)
    with pytest.raises(ConfigError, match="pip install"):
        make_viewer("rerun")


def test_rerun_records_a_run(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    run, file = make_run(), tmp_path / "run.rrd"
    scene = FakeSystem(run)
    viewer = RerunViewer(save=file)
    for frame in run.frames:
        viewer.show(frame.result, scene)
    viewer.finish(run)
    data = file.read_bytes()
    for entity in (b"world/points", b"world/path", b"world/camera", b"image/keypoints", b"counts/inliers", b"state"):
        assert entity in data, entity
