"""The commands `thegra benchmark ros` and `thegra benchmark soak`. This module imports no ROS."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thegra_core.config import ThegraConfig, load_config, parse_assignments
from thegra_core.errors import ConfigError
from thegra_ros.commands import need_ros

if TYPE_CHECKING:
    from thegra_core.geometry.camera import CameraModel
    from thegra_core.messages import Frame
    from thegra_core.sources.recording import Recording

LIGHT = ("extractor.name=orb", "preprocessing.filters=[{filter: he_clip}]", "loop.enabled=false")
"""A front end that takes little of the time, so that what ROS takes can be told."""
SIMULATED_S, SIMULATED_HZ = 8.0, 10.0

InputArgument = Annotated[Path | None, typer.Argument(metavar="[INPUT]", help="A recording. Default: a simulated 640x512 room.")]
ProfileOption = Annotated[str | None, typer.Option(help="paper, quality, fast or realtime. Default: fast with ORB and one light filter.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter; repeatable.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def ros(
    recording: InputArgument = None,
    profile: ProfileOption = None,
    rate: Annotated[float, typer.Option(min=0.01, help="Frames a second; so few that each is done before the next comes.")] = 2.0,
    max_frames: Annotated[int, typer.Option(min=2, help="Use the first frames only.")] = 80,
    set_: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """How much later a pose comes by way of ROS: one node, and four, against the system called directly, on the same frames at the same rate.

    Example: `thegra benchmark ros flight.mcap --rate 1`
    """
    need_ros("thegra benchmark ros")
    from thegra_ros.benchmark.latency import benchmark
    from thegra_ros.benchmark.processes import use_own_domain

    use_own_domain()
    config = _config(profile, set_)
    with _recording(recording) as opened, _status() as say:
        frames, camera = _frames(opened, max_frames)
        content = benchmark(frames, camera, config, rate, say)
    if as_json:
        typer.echo(json.dumps(content, indent=2))
        return
    width, height = content["image_size"]
    typer.echo(f"{width}x{height}, {config.extractor.name}, {rate:g} frames a second, {len(frames)} frames")
    typer.echo(f"{'no keyframes:':<16}{'frames':>8}{'direct ms':>11}{'by ROS ms':>11}{'overhead ms':>13}{'p95':>8}{'target':>8}   keyframes: overhead ms")
    for row in content["graphs"]:
        keyframes = f"{row['keyframe_overhead_ms']:.2f} ({row['keyframes']})" if row["keyframes"] else "-"
        typer.echo(
            f"{row['graph']:<16}{row['frames']:>8}{row['direct_ms']:>11.1f}{row['ros_ms']:>11.1f}{row['overhead_ms']:>13.2f}{row['overhead_p95_ms']:>8.2f}{row['target_ms']:>8.0f}   {keyframes}"
        )


def soak(
    recording: InputArgument = None,
    minutes: Annotated[float, typer.Option(min=0.05, help="How long.")] = 10.0,
    warm_up: Annotated[float, typer.Option(metavar="S", min=0.0, help="Seconds at the beginning that do not count.")] = 120.0,
    rate: Annotated[float, typer.Option(min=0.1, help="Frames a second.")] = 15.0,
    stages: Annotated[bool, typer.Option("--stages", help="The four nodes in place of one.")] = False,
    profile: ProfileOption = None,
    set_: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Play a recording over and over into the node and watch its memory. Exit code 1: it grew by more than 5 % after the warm-up, or nothing was tracked then.

    Example: `thegra benchmark soak flight.mcap --minutes 10 --rate 15`
    """
    need_ros("thegra benchmark soak")
    from thegra_ros.benchmark.processes import use_own_domain
    from thegra_ros.benchmark.soak import Plan
    from thegra_ros.benchmark.soak import soak as go

    if 60 * minutes < warm_up + 10:
        raise ConfigError(f"--minutes {minutes:g} leaves nothing after a warm-up of {warm_up:g} s: give more, or a shorter --warm-up")

    use_own_domain()
    config = _config(profile, set_)
    with _recording(recording) as opened, _status() as say:
        content = go(opened.path, config, Plan(minutes, warm_up, rate, _rate_of(opened), "four processes" if stages else "one process"), say)
    if as_json:
        typer.echo(json.dumps(content, indent=2))
    else:
        typer.echo(
            f"{content['graph']}, {minutes:g} minutes at {rate:g} frames a second: {content['images']} images received, {content['dropped']} of them dropped, "
            f"tracking for {content['tracking_pct']} % of the time\nmemory {content['warm_mb']} MB after {warm_up:g} s, from then on growth {content['growth_pct']} %, peak {content['peak_mb']} MB"
        )
    if content["tracking_pct"] == 0:
        typer.echo("nothing was tracked after the warm-up: this says nothing about the memory of a map; take a lower --rate", err=True)
    if content["growth_pct"] > content["most_growth_pct"] or content["tracking_pct"] == 0:
        raise typer.Exit(1)


def _config(profile: str | None, assignments: Sequence[str] | None) -> ThegraConfig:
    """What is named, beside the light front end where no profile is."""
    light = LIGHT if profile is None else ()
    return load_config(profile or "fast", overrides=parse_assignments([*light, *(assignments or ())]))


@contextmanager
def _recording(path: Path | None) -> Iterator[Recording]:
    from thegra_core.simulation.simulate import SimulationOptions, simulate
    from thegra_core.sources.open import open_recording

    if path is not None:
        yield open_recording(path)
        return
    with TemporaryDirectory(prefix="thegra_") as folder:
        options = SimulationOptions(scene="room", style="aggressive", duration_s=SIMULATED_S, rate_hz=SIMULATED_HZ)
        yield open_recording(simulate(options, Path(folder) / "bag"))


def _frames(recording: Recording, most: int) -> tuple[list[Frame], CameraModel]:
    from thegra_core.sources.open import camera_for

    return list(itertools.islice(recording.frames(), most)), camera_for(recording, None)


def _rate_of(recording: Recording) -> float:
    import numpy as np

    stamps = np.array([frame.stamp_ns for frame in itertools.islice(recording.frames(), 50)])
    return float(1e9 / np.median(np.diff(stamps)))


@contextmanager
def _status() -> Iterator[Callable[[str], Any]]:
    from rich.console import Console

    with Console(stderr=True).status("reading the recording") as status:
        yield status.update
