"""The RGB-D benchmark of TUM (Sturm et al. 2012): folders with `rgb.txt` and `groundtruth.txt`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.below import below
from thegra_core.evaluation.datasets.pose_table import read_pose_table
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Options, Reference
from thegra_core.evaluation.datasets.staging import camera_preset
from thegra_core.sources.calibration import BESIDE
from thegra_core.sources.folder import LISTS, natural_key


def find_tum(folders: Sequence[Path], options: Options) -> Found:
    """Every folder, at any depth, with a list of images and a ground truth; `freiburgN` in its name tells the camera unless it brings its own.

    Raises:
        InputError: If there is none.
    """
    lists = sorted((p for p in below(folders) if p.name in LISTS and p.is_file()), key=lambda p: natural_key(str(p)))
    homes = dict.fromkeys(p.parent for p in lists if (p.parent / "groundtruth.txt").is_file())
    if not homes:
        raise InputError(f"no sequence of TUM's form in {', '.join(map(str, folders))}: no folder holds rgb.txt (or images.txt) and groundtruth.txt; get them at cvg.cit.tum.de/data/datasets/rgbd-dataset")
    return Found(tuple(_sequence(home, options) for home in homes))


def _sequence(home: Path, options: Options) -> DataSequence:
    name = home.resolve().name
    rig = re.search(r"freiburg([123])", name)
    own = next((home / file for file in BESIDE if (home / file).is_file()), None)
    camera = options.camera or (str(own) if own is not None else camera_preset(f"tum_freiburg{rig[1]}") if rig else None)
    truth = home / "groundtruth.txt"
    return DataSequence(name, home, None, camera, partial(_reference, truth), (f"camera {camera or 'of the recording'}",), row=name, reference_files=(truth,))


def _reference(file: Path) -> Reference:
    table = read_pose_table(file)
    return Reference(table.trajectory, f"table {table.decision}")
