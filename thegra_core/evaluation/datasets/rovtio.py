"""The recordings of ROVTIO (Flemmen 2021), the paper's Table I: six folders of split bags.

The paper ran "subsequences of about 30 s as provided by the authors", most plausibly the bag files; whole recordings and windows of 30 s are there to compare.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rosbags import rosbag1

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.bag_poses import pose_topics, read_bag_poses
from thegra_core.evaluation.datasets.below import below
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Missing, Options, Reference
from thegra_core.evaluation.datasets.staging import camera_preset, linked_bags
from thegra_core.evaluation.datasets.thermal_topic import thermal_topic
from thegra_core.sources.calibration import BESIDE
from thegra_core.sources.folder import natural_key

SEQUENCES = ("alt1", "alt2", "sync", "lt1", "lt2", "lt3")
TOPICS = ("/tau_nodelet/thermal_image",)
SIZE = (640, 512)
LOAM = "/aft_mapped_to_init_CORRECTED"
VICON = "/vicon/charlie/charlie"
_SHORTEST_S = 5.0
_GET = "download {name}.zip from the folder that the README of github.com/ntnu-arl/rovtio names, and unpack it to a folder {name} below the one you give"


def find_rovtio(folders: Sequence[Path], options: Options) -> Found:
    """The sequences in some folders, cut into pieces as `options.pieces` says, in the paper's order.

    Raises:
        InputError: If there is none.
    """
    found: list[DataSequence] = []
    missing: list[Missing] = []
    places = {name: _bags(folders, name) for name in SEQUENCES}
    if not any(places.values()):
        raise InputError(f"no recording of ROVTIO in {', '.join(map(str, folders))}: no folder {', '.join(SEQUENCES)} with bags; {_GET.format(name='each')}")
    for name, bags in places.items():
        if not bags:
            missing.append(Missing(name, _GET.format(name=name)))
            continue
        try:
            found += _pieces(name, bags, options)
        except InputError as error:
            missing.append(Missing(name, str(error)))
    return Found(tuple(found), tuple(missing))


def in_order(bags: Sequence[Path]) -> list[Path]:
    """Split bags by the number at the end of their names; those without one after them, by name."""

    def key(path: Path) -> tuple[int, int, tuple[tuple[int, int, str], ...]]:
        number = re.search(r"_(\d+)$", path.stem)
        return (0, int(number[1]), ()) if number else (1, 0, natural_key(path.name))

    return sorted(bags, key=key)


def _bags(folders: Sequence[Path], name: str) -> list[Path]:
    """The bag files of the first folder of that name, or the single bag of that name."""
    places = [f for folder in folders for f in ([folder] if folder.name.lower() == name else sorted(p for p in below([folder]) if p.name.lower() == name)) if f.is_dir()]
    for place in places:
        bags = sorted(p for p in below([place]) if p.suffix == ".bag")
        if bags:
            return in_order(bags)
    return sorted(p for p in below(folders) if p.suffix == ".bag" and p.stem.lower() == name)[:1]


def _pieces(name: str, bags: list[Path], options: Options) -> list[DataSequence]:
    topic, told = thermal_topic(bags[0], TOPICS, SIZE)
    own = next((str(file) for file in (bags[0].parent / calibration for calibration in BESIDE) if file.is_file()), None)
    camera = options.camera or own or camera_preset("rovtio_tau2")
    reference, which = _reference(bags, options)
    notes = (told, which, f"camera {camera}")
    if options.pieces == "bags":
        # a reference is computed with a delay, so the last poses of a piece may lie in the next bag
        near = [bags[max(i - 1, 0) : i + 2] for i in range(len(bags))]
        read = [None if reference is None else partial(reference.func, beside, *reference.args[1:]) for beside in near]
        return [
            DataSequence(f"{name}_{i:02d}", bag, topic, camera, read[i], (*notes, f"bag {bag.name}"), row=name, reference_files=tuple(near[i]))
            for i, bag in enumerate(bags)
        ]
    whole = bags[0] if len(bags) == 1 else linked_bags(options.work / name, bags)
    if options.pieces == "whole":
        return [DataSequence(name, whole, topic, camera, reference, (*notes, f"{len(bags)} bags as one"), row=name, reference_files=tuple(bags))]
    length = _length_s(bags)
    count = max(1, int(length // options.window_s) + (length % options.window_s >= _SHORTEST_S))
    return [
        DataSequence(
            f"{name}_{i:02d}", whole, topic, camera, reference, (*notes, f"window of {options.window_s:g} s from {i * options.window_s:g} s"), row=name,
            start_s=i * options.window_s, duration_s=options.window_s, reference_files=tuple(bags),
        )
        for i in range(count)
    ]


def _reference(bags: list[Path], options: Options) -> tuple[partial[Reference] | None, str]:
    """How to read the reference of all bags of a recording, and which one it is."""
    topics = pose_topics(bags)
    offered = [(what, topic) for what, topic in (("LOAM", LOAM), ("Vicon", VICON)) if topic in topics and options.reference in ("auto", what.lower())]
    if not offered:
        there = ", ".join(sorted(topics)) or "none"
        return None, f"no ground truth: {LOAM} (LOAM) or {VICON} (Vicon) asked for as {options.reference!r}; topics of poses: {there}; coverage only"
    what, topic = offered[0]
    other = f", {VICON} (Vicon) is there, too: --reference vicon" if len(offered) > 1 else ""
    return partial(read_bag_poses, bags, topic, what), f"reference {what} {topic}{other}"


def _length_s(bags: Sequence[Path]) -> float:
    """From the first to the last message of all bags, by the time of receipt."""
    begins, ends = [], []
    for bag in bags:
        try:
            with rosbag1.Reader(bag) as reader:
                begins.append(reader.start_time)
                ends.append(reader.end_time)
        except Exception as error:  # what is damaged decides what rosbags raises
            raise InputError(f"{bag} cannot be cut into windows, its index cannot be read ({error}); repair it with `rosbag reindex`, or use --pieces bags") from error
    return (max(ends) - min(begins)) * 1e-9
