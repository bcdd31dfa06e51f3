"""A simulated recording is read back as it was made, in every format, and is the same for the same seed."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from thegra_core.errors import InputError
from thegra_core.outputs.trajectory import read_tum
from thegra_core.simulation.simulate import START_NS, SimulationOptions, rendered, simulate
from thegra_core.simulation.writers import WRITERS
from thegra_core.sources.open import camera_for, open_recording

SMALL = SimulationOptions(duration_s=1.2, image_size=(80, 64))


def digest(folder: Path) -> str:
    total = hashlib.sha256()
    for file in sorted(f for f in folder.rglob("*") if f.is_file()):
        total.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return total.hexdigest()


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_every_format_is_read_back_as_it_was_made(tmp_path: Path, name: str) -> None:
    lens = "tau2" if name == "rovtio" else "a65"
    made = rendered(SMALL, lens)
    ticks = list(made.ticks)
    recording = open_recording(simulate(SMALL, tmp_path / "out", name))
    frames = list(recording.frames())
    assert [frame.stamp_ns for frame in frames] == [tick.stamp_ns for tick in ticks]
    assert all(np.array_equal(frame.image, tick.image) and frame.image.dtype == np.uint16 for frame, tick in zip(frames, ticks, strict=True))
    assert not recording.problems
    camera = camera_for(recording)
    assert np.allclose(camera.matrix, made.camera.matrix) and np.allclose(camera.distortion, made.camera.distortion) and camera.model is made.camera.model
    truth = read_tum(recording.groundtruth)
    assert truth.stamps_ns.tolist() == [tick.stamp_ns for tick in ticks]
    assert np.allclose(truth.poses, [tick.world_from_camera for tick in ticks], atol=1e-8)


def test_stamps_have_the_rate_asked_for(tmp_path: Path) -> None:
    folder = simulate(SMALL.model_copy(update={"rate_hz": 12.5, "duration_s": 0.4}), tmp_path / "out", "folder")
    assert [frame.stamp_ns - START_NS for frame in open_recording(folder).frames()] == [0, 80_000_000, 160_000_000, 240_000_000, 320_000_000]


def test_same_seed_same_bytes_and_another_seed_other_images(tmp_path: Path) -> None:
    made = [simulate(SMALL.model_copy(update={"seed": seed}), tmp_path / str(k), "folder") for k, seed in enumerate((5, 5, 6))]
    assert digest(made[0]) == digest(made[1]) != digest(made[2])


def test_what_is_there_is_not_overwritten(tmp_path: Path) -> None:
    simulate(SMALL.model_copy(update={"duration_s": 0.1}), tmp_path / "out")
    with pytest.raises(InputError, match="exists already"):
        simulate(SMALL, tmp_path / "out")


def test_progress_counts_to_the_end(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    simulate(SMALL.model_copy(update={"duration_s": 0.5}), tmp_path / "out", "folder", lambda done, total: calls.append((done, total)))
    assert calls == [(done, 5) for done in range(6)]
