"""A folder of 16-bit images with a list of stamps: what `thegra run FOLDER` reads."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.outputs.trajectory import format_stamp
from thegra_core.simulation.recording import Simulated
from thegra_core.simulation.writers.files import write_beside

_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def write_folder(out_dir: Path, recording: Simulated) -> Path:
    """Write a recording; returns `out_dir`."""
    (out_dir / "images").mkdir(parents=True, exist_ok=True)
    truth: list[tuple[int, NDArray[np.float64]]] = []
    lines: list[str] = []
    for tick in recording.ticks:
        if tick.image is not None:
            name = f"images/{len(lines):06d}.png"
            cv2.imwrite(str(out_dir / name), tick.image, _FAST)
            lines.append(f"{format_stamp(tick.stamp_ns)} {name}\n")
        if tick.world_from_camera is not None:
            truth.append((tick.stamp_ns, tick.world_from_camera))
    (out_dir / "images.txt").write_text("".join(lines), encoding="utf-8")
    write_beside(out_dir, recording, truth)
    return out_dir
