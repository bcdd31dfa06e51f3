"""ViViD++ (Lee et al. 2022), the hand-held sequences of the paper's Table II.

The data set's own lists spell its names in several ways: one s or two in "aggressive", the light before the motion in bags and after it in ground
truth, with `indoor_` or without. A sequence is therefore known by its light and its motion.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path

import numpy as np

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.bag_poses import pose_topics, read_bag_poses
from thegra_core.evaluation.datasets.below import below
from thegra_core.evaluation.datasets.pose_table import read_pose_table
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Missing, Options, Reference
from thegra_core.evaluation.datasets.staging import camera_preset, image_list
from thegra_core.evaluation.datasets.thermal_topic import thermal_topic
from thegra_core.messages import IntArray
from thegra_core.outputs.scoring import spread_of
from thegra_core.outputs.trajectory import Trajectory
from thegra_core.sources.folder import natural_key

Key = tuple[str, str]
SEQUENCES: dict[Key, str] = {
    ("dark", "aggressive"): "dark_aggresive",
    ("dark", "robust"): "dark_robust",
    ("dark", "unstable"): "dark_unstable",
    ("global", "aggressive"): "global_aggresive",
    ("global", "robust"): "global_robust",
    ("global", "unstable"): "global_unstable",
    ("local", "aggressive"): "local_aggressive",
    ("local", "robust"): "local_robust",
    ("local", "unstable"): "local_unstable",
    ("varying", "robust"): "varying_robust",
    ("day1", "robust"): "outdoor_robust_day1",
    ("day2", "robust"): "outdoor_robust_day2",
    ("night1", "robust"): "outdoor_robust_night1",
    ("night2", "robust"): "outdoor_robust_night2",
}
"""Light and motion to the paper's name, in the paper's order."""
TOPICS = ("/thermal/image_raw",)
SIZE = (640, 512)
_LIGHTS = {light for light, _ in SEQUENCES}
_MOTIONS = {motion for _, motion in SEQUENCES}
_OTHER = {"driving", "campus", "city", "map", "times", "velocity", "rgb", "event"}
_SEOUL = timezone(timedelta(hours=9))
_MILLIMETRES = 50.0
"""RMS spread in the file's unit beyond which an indoor trajectory is not in metres."""
_GET = "ask for the data set with the form at visibilitydataset.github.io (academic addresses), and put {what} anywhere below the folder you give"


def find_vivid(folders: Sequence[Path], options: Options) -> Found:
    """The sequences in some folders, in the paper's order: bags, and folders of the post-processed release (`Thermal/data`).

    Raises:
        InputError: If there is none.
    """
    files = sorted(below(folders), key=lambda p: natural_key(str(p)))
    recordings, tables = _by_key(filter(_is_recording, files)), _by_key(filter(_is_table, files))
    camera = options.camera or _camchain(files) or camera_preset("vivid_handheld_thermal")
    found, missing = [], []
    for key, name in SEQUENCES.items():
        candidates = sorted(recordings.get(key, []), key=lambda p: p.is_dir())
        if not candidates:
            missing.append(Missing(name, _GET.format(what=f"{name}.bag")))
            continue
        try:
            found.append(_sequence(name, candidates, tables.get(key, []), camera, options))
        except InputError as error:
            missing.append(Missing(name, str(error)))
    if not found and not any(recordings.get(key) for key in SEQUENCES):
        raise InputError(f"no sequence of ViViD++ in {', '.join(map(str, folders))}: no bag is called like dark_robust.bag or indoor_robust_dark.bag; {_GET.format(what='the bags')}")
    return Found(tuple(found), tuple(missing))


def key_of(name: str) -> Key | None:
    """Light and motion that a file or folder name tells, in any order and spelling; None if it tells not exactly one of each."""
    text = re.sub(r"(day|night)[_\- ]?([12])", r" \1\2 ", name.lower())
    words = {re.sub(r"^agg?ress?ive$", "aggressive", word) for word in re.findall(r"[a-z]+[12]?", text)}
    lights, motions = words & _LIGHTS, words & _MOTIONS
    if len(lights) != 1 or len(motions) != 1 or words & _OTHER:
        return None
    key = (lights.pop(), motions.pop())
    return key if key in SEQUENCES else None


def _sequence(name: str, candidates: Sequence[Path], tables: Sequence[Path], camera: str, options: Options) -> DataSequence:
    recording = candidates[0]
    notes = [f"also there, not used: {path}" for path in candidates[1:]] + [f"camera {camera}"]
    if (recording / "Thermal").is_dir():
        return _post_processed(name, recording, notes, camera, options)
    topic, told = thermal_topic(recording, TOPICS, SIZE)
    table = min(tables, key=_preference, default=None)
    reference = partial(_from_table, table, name) if table is not None else _from_topics(recording)
    if reference is None:
        notes.append(f"no ground truth: neither a topic of poses nor a table like {_gt_name(name)}; coverage only")
    files = () if table is None else (table, *_times_of(table))
    return DataSequence(name, recording, topic, camera, reference, (told, *notes), row=name, reference_files=files)


def _from_table(table: Path, name: str) -> Reference:
    read = read_pose_table(table, *map(_stamps, _times_of(table)))
    trajectory, source = read.trajectory, ("LOAM" if name.startswith("outdoor") else "Vicon") + f" table {read.decision}"
    if not name.startswith("outdoor") and spread_of(trajectory.positions) > _MILLIMETRES:
        trajectory = _scaled(trajectory, 1e-3)
        source += "; millimetres by magnitude"
    return Reference(trajectory, source)


def _times_of(table: Path) -> tuple[Path, ...]:
    """The file with the times of a table's lines, if there is one beside it."""
    named = (table.with_name(table.name.replace("_optimized_poses", "_times")), table.with_name(f"{table.stem}_times.txt"))
    return tuple(f for f in named if f.is_file() and f != table)[:1]


def _from_topics(recording: Path) -> partial[Reference] | None:
    topics = pose_topics([recording])
    if not topics:
        return None
    return partial(read_bag_poses, [recording], sorted(topics)[0], "topic of the bag")


def _post_processed(name: str, folder: Path, notes: list[str], camera: str, options: Options) -> DataSequence:
    """Shin et al.'s release: numbered images, their times in Seoul's local time, and poses of the thermal camera, a line an image."""
    images = sorted((folder / "Thermal" / "data").glob("*.png"), key=lambda p: natural_key(p.name))
    stamps = _stamps(folder / "Thermal" / "timestamps.txt")
    if len(images) != len(stamps) or not images:
        raise InputError(f"{folder}/Thermal has {len(images)} images but {len(stamps)} times; unpack the archive again")
    recording = image_list(options.work / name, zip(stamps.tolist(), images, strict=True))
    poses = folder / "poses_thermal.txt"
    reference = partial(_from_lines, poses, stamps) if poses.is_file() else None
    notes.append("post-processed release: times are Seoul's" + ("" if reference else "; no poses_thermal.txt, coverage only"))
    files = (poses, folder / "Thermal" / "timestamps.txt") if reference else ()
    return DataSequence(name, recording, None, camera, reference, tuple(notes), row=name, reference_files=files)


def _from_lines(poses: Path, stamps: IntArray) -> Reference:
    table = read_pose_table(poses, stamps)
    return Reference(table.trajectory, f"poses of the thermal camera, {table.decision}")


def _stamps(file: Path) -> IntArray:
    """Stamps (N,) in ns of `YYYY-MM-DD hh:mm:ss.fraction` (Seoul) or seconds, a line each."""
    try:
        lines = [line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from error
    stamps = []
    for number, line in enumerate(lines, 1):
        try:
            stamps.append(_stamp(line))
        except ValueError as error:
            raise InputError(f"{file}:{number}: expected `YYYY-MM-DD hh:mm:ss.fraction` or seconds, got {line!r}") from error
    return np.array(stamps, np.int64)


def _stamp(line: str) -> int:
    if "-" not in line[1:]:
        return round(float(line) * 1e9) if float(line) < 1e11 else int(float(line))
    whole, _, fraction = line.partition(".")
    moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=_SEOUL)
    return int(moment.timestamp()) * 10**9 + int(f"{fraction:0<9}"[:9])


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return (path / "Thermal" / "data").is_dir() or (path / "metadata.yaml").is_file()
    return path.suffix in (".bag", ".mcap") and not (path.parent / "metadata.yaml").is_file()


def _is_table(path: Path) -> bool:
    return path.suffix in (".csv", ".txt", ".tum") and path.is_file()


def _by_key(paths: Iterable[Path]) -> dict[Key, list[Path]]:
    found: dict[Key, list[Path]] = {}
    for path in paths:
        key = key_of(path.name if path.is_dir() else path.stem)
        if key is not None:
            found.setdefault(key, []).append(path)
    return found


def _preference(path: Path) -> tuple[int, str]:
    """Ground truth by name before others, csv before text."""
    marks = [re.search(r"_gt$|groundtruth", path.stem) is None, re.search(r"pose|path", path.stem) is None, path.suffix != ".csv"]
    return sum(mark << (2 - i) for i, mark in enumerate(marks)), str(path)


def _camchain(files: Sequence[Path]) -> str | None:
    chain = next((f for f in files if f.name == "camchain-therrgb.yaml" and "driving" not in str(f.parent.name)), None)
    return None if chain is None else f"{chain}:cam0"


def _gt_name(name: str) -> str:
    light, _, motion = name.partition("_")
    return f"path_{name}.csv" if light == "outdoor" else f"indoor_{motion}_{light}_gt.csv"


def _scaled(trajectory: Trajectory, factor: float) -> Trajectory:
    poses = trajectory.poses.copy()
    poses[:, :3, 3] *= factor
    return Trajectory(trajectory.stamps_ns, poses)
