"""Simulated thermal recordings with exact ground truth: a scene, a hand that carries the camera, a sensor, a file format."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from thegra_core.errors import InputError
from thegra_core.outputs.files import writing_to
from thegra_core.simulation.cameras import Lens, thermal_camera
from thegra_core.simulation.exposure import Exposure
from thegra_core.simulation.paths import STYLES, HandHeldPath, StyleName
from thegra_core.simulation.recording import Simulated, Tick
from thegra_core.simulation.renderer import Renderer
from thegra_core.simulation.replay import replay
from thegra_core.simulation.scenes import SCENES, SceneName
from thegra_core.simulation.sensor import Sensor
from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.simulation.timing import Fate, Schedule, make_schedule
from thegra_core.simulation.writers import WRITERS

Format = Literal["mcap", "vivid", "rovtio", "folder"]
ProgressCallback = Callable[[int, int], None]
"""Called after each frame with frames done and frames in all."""

START_NS = 1_700_000_000_000_000_000
_LAPS = 1.15  # of a recording whose length nobody chose: it comes back to where it began


class SimulationOptions(BaseModel):
    """What to simulate; the same options give the same bytes."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: SceneName = Field("room", description="room, corridor, street or tunnel")
    style: StyleName = Field("robust", description="how the camera is carried: robust (calm), unstable (shaky) or aggressive (fast)")
    duration_s: float | None = Field(None, gt=0, description="s; default: once round the scene and a little more")
    rate_hz: float = Field(10.0, gt=0, le=120, description="frames a second")
    image_size: tuple[int, int] = Field((640, 512), description="width, height in px")
    shutter: Literal["none", "gap", "freeze"] = Field("none", description="what the stream shows while the shutter is closed: it never closes, no frames, or the last frame again")
    seed: int = Field(0, ge=0, description="of the scene, the path and the sensor")
    source: Path | None = Field(None, description="a recording whose images take the place of the scene's")
    source_counts_per_kelvin: float | None = Field(None, gt=0, description="of the source's images; default: 40, or 25 grey levels where they have 8 bits")
    sensor: SensorConfig = Field(default_factory=lambda: SensorConfig(), description="the camera")


def simulate(options: SimulationOptions, out_dir: Path, format: Format = "mcap", progress: ProgressCallback | None = None) -> Path:  # noqa: A002
    """Simulate a recording and write it to a new folder.

    Args:
        format: "mcap" (a rosbag2 folder), "folder" (16-bit images with a list), or ROS 1 bags as in "vivid" (ViViD++) or "rovtio".

    Returns:
        What `thegra run` takes: `out_dir`, or the bag or the folder of bags in it.

    Raises:
        InputError: If the folder exists already, the source cannot be read, or trimesh and embreex are missing.
    """
    if format not in get_args(Format):
        raise InputError(f"unknown format {format!r}; choose one of {', '.join(get_args(Format))}")
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise InputError(f"{out_dir} exists already: remove it or name another folder with --out DIR")
    recording = replayed(options) if options.source is not None else rendered(options, "tau2" if format == "rovtio" else "a65")
    if progress is not None:
        recording = _watched(recording, progress)
    with writing_to(out_dir.parent):
        return WRITERS[format](out_dir, recording)


def rendered(options: SimulationOptions, lens: Lens = "a65") -> Simulated:
    """A recording of a rendered scene; images are made as its ticks are taken."""
    kind, style = SCENES[options.scene], STYLES[options.style]
    camera = thermal_camera(options.image_size, lens)
    duration_s = options.duration_s or _LAPS * HandHeldPath(kind.route(), style, 1.0, options.seed).lap_s
    path = HandHeldPath(kind.route(), style, duration_s, options.seed)
    times = np.rint(np.arange(max(1, round(duration_s * options.rate_hz))) * (1e9 / options.rate_hz)).astype(np.int64)
    schedule = make_schedule(times, options.sensor, options.shutter != "none", options.seed)
    exposure = Exposure(Renderer(kind.make(options.seed), camera), path, options.sensor)
    poses = path.poses(schedule.stamps_ns * 1e-9)
    stamps = schedule.stamps_ns + START_NS
    images = sensed((exposure.at(t * 1e-9) if fate is Fate.SEEN else None for t, fate in zip(times.tolist(), schedule.fates, strict=True)), schedule, options, camera.image_size)
    ticks = (Tick(stamp, image, pose) for stamp, image, pose in zip(stamps.tolist(), images, poses, strict=True))
    return Simulated(options.scene, options.style, kind.outdoors, camera, _closure_stamps(schedule, stamps), len(times), ticks)


def replayed(options: SimulationOptions) -> Simulated:
    """A recording whose images come from another one and pass through the simulated sensor."""
    assert options.source is not None
    source = replay(options.source, options.sensor, options.source_counts_per_kelvin)
    schedule = make_schedule(source.stamps_ns - source.stamps_ns[0], options.sensor, options.shutter != "none", options.seed)
    stamps = schedule.stamps_ns + source.stamps_ns[0]
    images = sensed(source.kelvin(), schedule, options, source.image_size)
    ticks = (Tick(stamp, image, source.pose_at(stamp)) for stamp, image in zip(stamps.tolist(), images, strict=True))
    return Simulated(source.name, options.style, False, source.camera, _closure_stamps(schedule, stamps), len(stamps), ticks)


def sensed(
    kelvin: Iterator[NDArray[np.float64] | None], schedule: Schedule, options: SimulationOptions, image_size: tuple[int, int]
) -> Iterator[NDArray[np.uint8] | NDArray[np.uint16] | None]:
    """What the camera sends for each of a schedule's frames: an image, the last one again while a frozen shutter is closed, or nothing."""
    sensor = Sensor(options.sensor, image_size, options.seed)
    reopened = {end for _, end in schedule.closures}
    last: NDArray[np.uint8] | NDArray[np.uint16] | None = None
    for index, (scene, time_ns, fate) in enumerate(zip(kelvin, schedule.times_ns.tolist(), schedule.fates, strict=True)):
        if index in reopened:
            sensor.correct(time_ns * 1e-9)
        if fate is Fate.SEEN:
            assert scene is not None
            last = sensor.expose(scene, time_ns * 1e-9)
            yield last
        else:
            yield last if fate is Fate.BLIND and options.shutter == "freeze" else None


def _closure_stamps(schedule: Schedule, stamps: NDArray[np.int64]) -> tuple[tuple[int, int], ...]:
    return tuple((int(stamps[begin]), int(stamps[end])) for begin, end in schedule.closures)


def _watched(recording: Simulated, progress: ProgressCallback) -> Simulated:
    def ticks() -> Iterator[Tick]:
        progress(0, recording.count)
        for done, tick in zip(itertools.count(1), recording.ticks):
            yield tick
            progress(done, recording.count)

    return Simulated(recording.name, recording.style, recording.outdoors, recording.camera, recording.closures_ns, recording.count, ticks())
