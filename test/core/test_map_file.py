"""Map files: exact round trips, files that are damaged or do not fit, writers that are killed, and runs that go on in a kept map."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from synthetic import CAMERA, FakeExtractor, FakeMatcher, loop, room, stamp
from test_slam import CONFIG, ate, frames, make, picture, play

from thegra_core.errors import InputError
from thegra_core.features.front_end import DetectEach
from thegra_core.map import archive
from thegra_core.map.archive import read_archive, write_archive
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import Frame, TrackingState
from thegra_core.slam import Slam

WORLD, PATH = room(1500), loop(65, turns=0.6)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of 50 frames of a loop."""
    slam = make(WORLD, PATH)
    play(slam, frames(50))
    file = tmp_path_factory.mktemp("maps") / "room.map"
    slam.save_map(file)
    return file


def resumed(file: Path, path: list[np.ndarray], first: int = 1000) -> tuple[Slam, list[Frame]]:
    """A system that begins in the map, and frames at later stamps along `path`."""
    stream = [Frame(stamp(first + i), i, picture(first + i)) for i in range(len(path))]
    slam = Slam(CAMERA, CONFIG, FakeExtractor(WORLD, {f.stamp_ns: pose for f, pose in zip(stream, path, strict=True)}), FakeMatcher())
    slam.load_map(file)
    return slam, stream


# ---- the archive -----------------------------------------------------------------------------------------------------------------


names = st.text("abc/_", min_size=1, max_size=6).filter(lambda n: not n.startswith("/") and not n.endswith("/") and "//" not in n)
values = hnp.arrays(st.sampled_from([np.uint8, np.int64, np.float32, np.float64]), hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=5))


@settings(deadline=None)
@given(st.dictionaries(names, values, max_size=4))
def test_arrays_come_back_as_they_were(tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]) -> None:
    file = tmp_path_factory.mktemp("a") / "x.map"
    write_archive(file, {"number": 1.1}, arrays)
    header, found = read_archive(file)
    assert header == {"number": 1.1} and found.keys() == arrays.keys()
    for name, wanted in arrays.items():
        assert found[name].dtype == wanted.dtype
        np.testing.assert_array_equal(found[name], wanted)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_file_cut_short_is_refused(kept: Path, tmp_path: Path, share: float) -> None:
    whole = kept.read_bytes()
    cut = tmp_path / "cut.map"
    cut.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=r"cut\.map is no whole map file"):
        read_archive(cut)


def test_a_changed_byte_is_noticed(kept: Path, tmp_path: Path) -> None:
    data = bytearray(kept.read_bytes())
    with zipfile.ZipFile(kept) as whole:
        inside = whole.getinfo("keyframes/descriptors.npy").header_offset + 5000
    data[inside] ^= 0x55
    changed = tmp_path / "changed.map"
    changed.write_bytes(data)
    with pytest.raises(InputError, match="no whole map file"):
        read_archive(changed)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "x.map"
    write_archive(file, {"n": 1}, {})

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archive.os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        write_archive(file, {"n": 2}, {})
    assert read_archive(file)[0] == {"n": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["x.map"], "nothing is left lying about"


def test_no_file_and_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no map file"):
        read_archive(tmp_path / "none.map")
    with pytest.raises(InputError, match=r"cannot write .*none/x\.map"):
        write_archive(tmp_path / "none" / "x.map", {}, {})


WRITER = """
import sys, numpy as np
from pathlib import Path
from thegra_core.map.archive import write_archive
path, number = Path(sys.argv[1]), 0
print("ready", flush=True)
while True:
    number += 1
    write_archive(path, {"number": number}, {"values": np.full(300_000, number)})
"""


def killed_writers(file: Path, times: int, seed: int) -> None:
    """Writers that are killed at random moments; what they leave is whole."""
    rng = np.random.default_rng(seed)
    write_archive(file, {"number": 0}, {"values": np.zeros(300_000, np.int64)})
    for _ in range(times):
        with subprocess.Popen([sys.executable, "-c", WRITER, str(file)], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None and writer.stdout.readline() == b"ready\n"
            try:
                writer.wait(timeout=float(rng.uniform(0.0, 0.15)))
            except subprocess.TimeoutExpired:
                os.kill(writer.pid, signal.SIGKILL)
        header, arrays = read_archive(file)
        assert np.all(arrays["values"] == header["number"]) and len(arrays["values"]) == 300_000


def test_a_killed_writer_leaves_a_whole_file(tmp_path: Path) -> None:
    killed_writers(tmp_path / "x.map", 5, 0)


@pytest.mark.slow
def test_fifty_killed_writers_leave_whole_files(tmp_path: Path) -> None:
    killed_writers(tmp_path / "x.map", 50, 1)


# ---- maps ------------------------------------------------------------------------------------------------------------------------


def test_a_map_that_is_read_is_written_to_the_same_bytes(kept: Path, tmp_path: Path) -> None:
    mapper = Mapper(CAMERA, CONFIG, FakeMatcher())
    update = mapper.load(kept)
    mapper.save(update.map_id, tmp_path / "again.map")
    assert (tmp_path / "again.map").read_bytes() == kept.read_bytes()


def rewritten(kept: Path, to: Path, **changes: object) -> Path:
    header, arrays = read_archive(kept)
    write_archive(to, header | changes, arrays)
    return to


def test_files_that_do_not_fit_say_what_to_do(kept: Path, tmp_path: Path) -> None:
    mapper = Mapper(CAMERA, CONFIG, FakeMatcher())
    with pytest.raises(InputError, match=r"has version 99 of the map format.*reads version 1"):
        mapper.load(rewritten(kept, tmp_path / "v.map", format_version=99))
    with pytest.raises(InputError, match=r"made with superpoint features, this run uses aliked.*--set extractor.name=superpoint"):
        mapper.load(rewritten(kept, tmp_path / "e.map", extractor="superpoint"))
    with pytest.raises(InputError, match="is no map file of Thegra"):
        mapper.load(rewritten(kept, tmp_path / "f.map", format="other"))
    moved = dataclasses.replace(CAMERA, matrix=CAMERA.matrix + np.diag([5.0, 5.0, 0.0]))
    with pytest.raises(InputError, match=r"another camera: 640x512 plumb_bob fx 520\.00.*fx 525\.00"):
        Mapper(moved, CONFIG, FakeMatcher()).load(kept)
    header, arrays = read_archive(kept)
    del arrays["landmarks/visible"]
    write_archive(tmp_path / "m.map", header, arrays)
    with pytest.raises(InputError, match=r"does not fit together.*landmarks/visible"):
        mapper.load(tmp_path / "m.map")


def test_the_header_is_plain_json(kept: Path) -> None:
    with zipfile.ZipFile(kept) as opened:
        header = json.loads(opened.read("header.json"))
    assert header["format_version"] == 1 and header["camera"]["image_size"] == [640, 512] and header["keyframes"] >= 5


def test_a_run_goes_on_in_a_kept_map(kept: Path) -> None:
    slam, stream = resumed(kept, PATH[25:40])
    results = [slam.process(frame) for frame in stream]
    assert results[0].state is TrackingState.TRACKING, "the first frame is found by what it looks like"
    assert all(r.state is TrackingState.TRACKING and r.map_id == 0 for r in results)
    run = slam.finish()
    assert (len(run.maps), run.relocalizations, run.losses) == (1, 1, 0)
    assert all(r.is_keyframe is False or r.reference_id > 0 for r in results)


def test_poses_are_in_the_world_of_the_kept_map(kept: Path) -> None:
    slam, stream = resumed(kept, PATH[35:45])
    before = {k.stamp_ns: k.world_from_camera.copy() for k in slam._mapping.maps()[0].keyframes.values()}
    depth = slam._mapping.maps()[0].median_depth(max(slam._mapping.maps()[0].keyframes))
    for offset, frame in enumerate(stream):
        found = slam.process(frame).world_from_camera
        wanted = before.get(stamp(35 + offset))
        assert found is not None
        if wanted is not None:
            assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < 0.01 * depth


def test_localization_only_leaves_the_map_alone(kept: Path, tmp_path: Path) -> None:
    slam, stream = resumed(kept, PATH[20:35])
    slam.localization_only = True
    results = [slam.process(frame) for frame in stream]
    assert all(r.state is TrackingState.TRACKING and not r.is_keyframe for r in results)
    slam.finish()
    slam.save_map(tmp_path / "same.map")
    assert (tmp_path / "same.map").read_bytes() == kept.read_bytes()


def test_a_place_outside_the_map_is_not_claimed(kept: Path) -> None:
    """Localising only, a camera in another world stays without a pose, and no map is begun."""
    slam, stream = resumed(kept, PATH[:10])
    slam._front_end = DetectEach(FakeExtractor(room(seed=5), {f.stamp_ns: pose for f, pose in zip(stream, PATH, strict=False)}))
    slam.localization_only = True
    results = [slam.process(frame) for frame in stream]
    assert {r.state for r in results} <= {TrackingState.RELOCALIZING, TrackingState.LOST}
    assert all(r.world_from_camera is None for r in results)
    assert len(slam.finish().maps) == 1


def test_a_lost_system_saves_its_map(tmp_path: Path) -> None:
    slam = make(WORLD, PATH[:35])  # later frames show nothing
    for frame in frames(38):
        last = slam.process(frame)
    assert last.state is TrackingState.LOST
    slam.save_map(tmp_path / "lost.map")
    again, stream = resumed(tmp_path / "lost.map", PATH[10:20])
    assert all(again.process(frame).state is TrackingState.TRACKING for frame in stream)


def test_without_a_map_there_is_nothing_to_save(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no map yet"):
        make(WORLD, PATH).save_map(tmp_path / "x.map")


def test_a_kidnapped_camera_is_found_where_it_was_before() -> None:
    """From the end of a path back to its first third, which the last keyframes do not see."""
    jumped = [*PATH, *PATH[10:22]]
    slam = make(WORLD, jumped)
    results, run = play(slam, frames(len(jumped)))
    back = [i for i in range(65, 77) if results[i].state is TrackingState.TRACKING and results[i].map_id == 0]
    assert back and back[0] - 65 < 5
    assert (run.losses, run.relocalizations, len(run.maps)) == (1, 1, 1)
    assert ate(run, jumped)[0] < 0.01
