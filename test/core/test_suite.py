"""The simulated suite: what it covers, made once, never mixed with something else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.errors import InputError
from thegra_core.evaluation import suite
from thegra_core.evaluation.suite import SUITE, make_suite
from thegra_core.simulation.simulate import SimulationOptions
from thegra_core.sources.open import camera_for, open_recording

TINY = SimulationOptions(duration_s=0.4, rate_hz=5, image_size=(64, 48), shutter="none")


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "SUITE", {"one": TINY, "two": TINY.model_copy(update={"seed": 2})})


def test_it_covers_scenes_styles_and_the_shutter() -> None:
    assert len(SUITE) >= 8
    assert {o.scene for o in SUITE.values()} == {"room", "corridor", "street", "tunnel"}
    assert {o.style for o in SUITE.values()} == {"robust", "unstable", "aggressive"}
    assert {o.shutter for o in SUITE.values()} == {"none", "gap", "freeze"}
    assert len({o.seed for o in SUITE.values()}) == len(SUITE)
    assert all(name.startswith(f"{o.scene}_{o.style}") and (o.shutter == "none" or name.endswith(o.shutter)) for name, o in SUITE.items())


def test_what_is_missing_is_made_and_what_is_there_is_left(tiny: None, tmp_path: Path) -> None:
    said: list[str] = []
    (one,) = make_suite(tmp_path, ["one"], lambda name, done, total: said.append(f"{name} {done}/{total}"))
    assert said == ["one 0/2", "one 1/2", "one 2/2"]
    recording = open_recording(one)
    assert recording.name == "one"
    assert recording.groundtruth == one / "groundtruth.txt"
    assert camera_for(recording).image_size == (64, 48)
    before = (one / "images.txt").stat().st_ino
    (tmp_path / ".two.part").mkdir()
    (tmp_path / ".two.part" / "half").write_text("of a run that was stopped")
    assert make_suite(tmp_path) == [one, tmp_path / "two"]
    assert (one / "images.txt").stat().st_ino == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one", "two"]
    assert not (tmp_path / "two" / "half").exists()


def test_something_else_of_that_name_is_not_touched(tiny: None, tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else"):
        make_suite(tmp_path)
    assert (tmp_path / "one" / "mine.txt").read_text() == "mine"


def test_the_benchmark_runs_the_suite_beside_recordings(tiny: None, tmp_path: Path) -> None:
    (beside,) = make_suite(tmp_path / "other", ["two"])
    beside = beside.rename(beside.with_name("beside"))
    arguments = ["benchmark", "slam", beside, "--suite", "--suite-dir", tmp_path / "suite", "--only", "one", "--profile", "fast", "--out", tmp_path / "out"]
    options = ["--set", "extractor.name=orb", "--set", "preprocessing.filters=[{filter: he_clip}]"]
    done = CliRunner().invoke(app, [*map(str, arguments), *options], env={"COLUMNS": "250", "TERM": "dumb"})
    assert done.exit_code == 0, done.output
    content = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [(r["recording"], r["profile"], r["failed"]) for r in content["results"]] == [("beside", "fast", []), ("one", "fast", [])]


def test_wrong_use_is_told(tmp_path: Path) -> None:
    for arguments, told in ((["slam"], "add --suite"), (["slam", "--suite", "--only", "garden"], "the suite has no such sequence; it has room_robust")):
        done = CliRunner().invoke(app, ["benchmark", *arguments, "--out", str(tmp_path)])
        assert done.exit_code == 2
        assert told in done.stderr
