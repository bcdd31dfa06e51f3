"""Whether a frame costs more the larger the map is: a long way through new places, with a front end that costs next to nothing."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from thegra_core.config import ThegraConfig
from thegra_core.messages import Frame, TrackingState
from thegra_core.simulation.points import CAMERA, EqualDescriptors, PointStreet, StreetExtractor
from thegra_core.slam import Slam

PERIOD_NS = 100_000_000
PARTS = 10
"""Equal parts of the run, of which the first with a settled map and the last are compared."""
_SETTLED = 1
_SMOOTHED = 50
_DPI = 150


@dataclass(frozen=True, slots=True)
class Sample:
    """A frame: milliseconds of the processor's time that it cost, how large the map was after it, and the memory of the process (MiB).

    The processor's time, for that on the clock tells as much of what else the machine does.
    """

    cpu_ms: float
    is_keyframe: bool
    tracked: bool
    keyframes: int
    landmarks: int
    rss_mb: float


def walk(config: ThegraConfig, minutes: float, keypoints: int, progress: Callable[[int, int], None]) -> list[Sample]:
    """Walk along a street of points at ten frames a second. progress is told frames done and in all."""
    frames = max(int(60 * minutes * 1e9 / PERIOD_NS), 1)
    street = PointStreet(frames, keypoints, seed=config.seed)
    slam = Slam(CAMERA, config, StreetExtractor(street), EqualDescriptors())
    rng = np.random.default_rng(config.seed)
    width, height = CAMERA.image_size
    samples = []
    for index in range(frames):
        image = rng.integers(0, 256, (height, width), dtype=np.uint8)  # something else each time, or it would pass for a closed shutter
        begin = time.process_time()
        result = slam.process(Frame(index * PERIOD_NS, index, image))
        cost = 1e3 * (time.process_time() - begin)
        samples.append(Sample(cost, result.is_keyframe, result.state is TrackingState.TRACKING, *slam.map_size(), _rss_mb()))
        progress(index + 1, frames)
    return samples


def summary(samples: Sequence[Sample]) -> dict[str, Any]:
    """Medians of the second and the last tenth, their ratio, and memory a keyframe between the two."""
    parts = np.array_split(np.arange(len(samples)), PARTS)
    early, late = ([samples[i] for i in parts[which]] for which in (_SETTLED, -1))
    told: dict[str, Any] = {
        "frames": len(samples),
        "tracked_pct": round(100.0 * sum(s.tracked for s in samples) / len(samples), 2),
        "keyframes": [early[-1].keyframes, late[-1].keyframes],
        "landmarks": [early[-1].landmarks, late[-1].landmarks],
    }
    for name, chosen in (("frame", False), ("keyframe", True)):
        costs = [[s.cpu_ms for s in part if s.is_keyframe is chosen] for part in (early, late)]
        medians = [float(np.median(c)) if c else None for c in costs]
        told[f"{name}_cpu_ms"] = [round(m, 2) if m is not None else None for m in medians]
        told[f"{name}_growth"] = round(medians[1] / medians[0], 3) if medians[0] and medians[1] else None
    more = late[-1].keyframes - early[-1].keyframes
    told["mb_per_keyframe"] = round((late[-1].rss_mb - early[-1].rss_mb) / more, 3) if more > 0 else None
    return told


def write(samples: Sequence[Sample], folder: Path) -> None:
    """growth.json with every frame, growth.png with times and map size over the run."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = {name: [asdict(s)[name] for s in samples] for name in asdict(samples[0])}
    (folder / "growth.json").write_text(json.dumps({"summary": summary(samples), "frames": columns}), encoding="utf-8")
    figure(samples).savefig(folder / "growth.png", dpi=_DPI)


def figure(samples: Sequence[Sample]) -> Figure:
    """Running medians of what a frame and a keyframe cost over the run, above the size of the map."""
    minutes = np.arange(len(samples)) * PERIOD_NS / 60e9
    drawn = Figure(figsize=(7, 5), layout="constrained")
    times, sizes = drawn.subplots(2, 1, sharex=True)
    for wanted, label in ((False, "a frame: tracking"), (True, "a keyframe: tracking and mapping")):
        rows = [i for i, s in enumerate(samples) if s.is_keyframe is wanted]
        times.plot(minutes[rows], _running_median([samples[i].cpu_ms for i in rows]), label=label)
    times.set_ylabel("ms of the processor's time")
    sizes.plot(minutes, [s.keyframes for s in samples], label="keyframes")
    sizes.plot(minutes, [s.rss_mb for s in samples], label="memory of the process / MB")
    sizes.set_xlabel("time of the recording / min")
    for axes in (times, sizes):
        axes.set_ylim(bottom=0)
        axes.legend()
    return drawn


def _running_median(values: Sequence[float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Median of each value and those around it (N,)."""
    if not values:
        return np.empty(0)
    padded = np.pad(np.asarray(values, dtype=np.float64), _SMOOTHED // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, _SMOOTHED + 1), axis=1))


def _rss_mb() -> float:
    """Resident memory of this process, MiB; NaN where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)
