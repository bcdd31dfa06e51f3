"""`thegra benchmark`: measure the system over recordings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thegra_core.config import PROFILES
from thegra_core.errors import ConfigError, InputError

if TYPE_CHECKING:
    from thegra_core.evaluation.benchmark.slam import PlannedRun, RunResult
    from thegra_core.messages import ImageArray

app = typer.Typer(no_args_is_help=True, help="Measure the system over recordings.")
SOME_FAILED = 1


@app.callback()
def benchmark() -> None:
    """Measure the system over recordings."""


@app.command("slam")
def slam(
    recordings: Annotated[list[Path] | None, typer.Argument(metavar="[DIR...]", help="Recordings as `thegra run` takes them, with groundtruth.txt and shutter.txt beside the images if there are.")] = None,
    suite: Annotated[bool, typer.Option("--suite", help="Also the fixed simulated suite; what is missing of it is made first.")] = False,
    suite_dir: Annotated[Path, typer.Option(metavar="DIR", help="Where the suite is kept.")] = Path("runs/suite"),
    only: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Of the suite only this sequence; repeatable.")] = None,
    profile: Annotated[list[str] | None, typer.Option(help="paper, quality, fast or realtime; repeatable. Default: quality; with --suite all.")] = None,
    runs: Annotated[int, typer.Option(min=1, metavar="N", help="Runs of each, with seeds 0 to N-1.")] = 1,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Runs at a time; times are then those of a shared machine.")] = 1,
    cache: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the networks' results there; their time is then missing from s/frame.")] = None,
    max_frames: Annotated[list[str] | None, typer.Option("--max-frames", metavar="NAME=N", help="Use the first N frames of the recording of that name; repeatable.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the tables and every run's results. Default: runs/benchmark_TIME.")] = None,
    peers: Annotated[Path | None, typer.Option(metavar="FILE", help='Results of other systems, JSON {sequence: {peer: {variant: {"tracked_pct": [...], "ate_rmse": [...]}}}}.')] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter for all runs; repeatable. `thegra config` lists them.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print results.json instead of the table.")] = False,
) -> None:
    """Run recordings with profiles and seeds, each in a process of its own, and tell coverage, error, time and memory.

    Example: `thegra benchmark slam recordings/* --profile quality --profile fast --runs 3 --out runs/benchmark`, or `thegra benchmark slam --suite`

    Writes results.json and results.md (a table for a README). Exit code: 0 all ran, 1 some run failed, 2 wrong use.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from thegra_core.evaluation.benchmark import slam as logic
    from thegra_core.evaluation.benchmark.peers import read_peers
    from thegra_core.evaluation.benchmark.tables import markdown

    if not recordings and not suite:
        raise InputError("nothing to run: name recordings, or add --suite for the simulated ones")
    made = _suite(suite_dir, only) if suite else []
    plan = logic.Plan(
        recordings=(*(recordings or ()), *made),
        out=out or Path("runs") / f"benchmark_{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}",
        profiles=tuple(dict.fromkeys(profile or (PROFILES if suite else ["quality"]))),
        runs=runs,
        cache=cache,
        max_frames=_limits(max_frames or []),
        assignments=tuple(set_ or ()),
        workers=workers,
    )
    others = read_peers(peers) if peers is not None else None
    total = len(logic.planned_runs(plan))
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=total)

        def before(run: PlannedRun) -> None:
            bar.update(task, description=f"{run.name} {run.profile} seed {run.seed}")

        def after(results: Sequence[RunResult]) -> None:
            content = logic.report(plan, results, others)
            logic.write_report(plan, content, markdown(content))
            bar.advance(task)

        results = logic.run_plan(plan, before, after)
    _show(logic.report(plan, results, others), plan.out, as_json)
    if any(result.error is not None for result in results):
        raise typer.Exit(SOME_FAILED)


@app.command("realtime")
def realtime(
    recordings: Annotated[list[Path] | None, typer.Argument(metavar="[DIR...]", help="Recordings as `thegra run` takes them. Default: a simulated room, in every --size at every --rate.")] = None,
    profile: Annotated[list[str] | None, typer.Option(help="paper, quality, fast or realtime; repeatable. Default: all.")] = None,
    suite: Annotated[bool, typer.Option("--suite", help="Instead of the room: the simulated suite, by default at 640x512 and 20 Hz.")] = False,
    size: Annotated[list[str] | None, typer.Option(metavar="WxH", help="Of the simulated images; repeatable. Default: 320x256 and 640x512.")] = None,
    rate: Annotated[list[float] | None, typer.Option(metavar="HZ", min=0.1, help="Of the simulated images; repeatable. Default: 10, 20 and 30.")] = None,
    duration: Annotated[float, typer.Option(metavar="S", min=1.0, help="Of the simulated room.")] = 20.0,
    recordings_dir: Annotated[Path, typer.Option(metavar="DIR", help="Where the simulated recordings are kept.")] = Path("runs/realtime"),
    offline: Annotated[bool, typer.Option("--offline/--no-offline", help="Also run each without haste, for the accuracy that haste may cost.")] = True,
    against: Annotated[str | None, typer.Option(metavar="PROFILE", help="Also run each offline with this profile, without --set, and tell how large the errors are beside its own.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the tables and every run's results. Default: runs/benchmark_TIME.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter for all runs; repeatable. `thegra config` lists them.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print results.json instead of the table.")] = False,
) -> None:
    """Play recordings at their own rate and tell latency, dropped frames and CPU time a frame, with the accuracy live and offline.

    Example: `thegra benchmark realtime --profile realtime --size 640x512 --rate 20`

    Writes results.json and results.md. Nothing else should use the machine meanwhile. Exit code: 0 all ran, 1 some run failed, 2 wrong use.
    """
    from rich.console import Console

    from thegra_core.cli.simulate import image_size
    from thegra_core.evaluation.benchmark import realtime as logic

    target = out or Path("runs") / f"benchmark_{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}"
    with Console(stderr=True).status("starting") as status:
        def say(name: str, done: int, total: int) -> None:
            status.update(f"simulating {name}: {done} of {total} frames")

        sizes = [image_size(text) for text in size or (("640x512",) if suite else ("320x256", "640x512"))]
        played = list(recordings or ())
        if suite:
            played += logic.simulated_suite(recordings_dir, sizes, rate or (20.0,), say)
        elif not played:
            played = logic.simulated(recordings_dir, sizes, rate or (10.0, 20.0, 30.0), duration, say)
        content = logic.benchmark(played, tuple(dict.fromkeys(profile or PROFILES)), target, offline, tuple(set_ or ()), status.update, against)
    print(json.dumps(content, indent=2, allow_nan=False) if as_json else logic.markdown(content))
    for failure in logic.failures(content):
        typer.echo(f"failed: {failure}", err=True)
    if logic.failures(content):
        raise typer.Exit(SOME_FAILED)


@app.command("preprocessing")
def preprocessing(
    recordings: Annotated[list[Path] | None, typer.Argument(metavar="[INPUT...]", help="Recordings to take frames from. Default: a simulated 640x512 scene.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each recording, evenly spread.")] = 3,
    repeats: Annotated[int, typer.Option(min=1, help="Times each frame is processed.")] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Time the filters and the paper's chain on one thread, beside scikit-image and OpenCV.

    Example: `thegra benchmark preprocessing flight.bag --frames 5`
    """
    from rich.console import Console
    from rich.table import Table

    from thegra_core.evaluation.benchmark import preprocessing as logic

    console = Console(stderr=True)
    with console.status("reading frames") as status:
        images = _frames_of(recordings or [], frames)
        content = logic.benchmark(images, repeats, status.update)
    if as_json:
        print(json.dumps(content, indent=2))
        return
    width, height = content["image_size"]
    table = Table(caption=f"Medians over {content['frames']} frames of {width}x{height}, one thread. Ratio: reference over ours.", caption_justify="left")
    for name in ("filter", "ms", "reference ms", "ratio"):
        table.add_column(name, justify="left" if name == "filter" else "right")
    for name, figures in [*content["filters"].items(), ("the paper's chain", content["chain"])]:
        reference = figures["reference_ms"]
        table.add_row(name, f"{figures['ms']:.2f}", f"{reference:.2f}" if reference else "–", f"{reference / figures['ms']:.1f}" if reference else "–")
    Console().print(table)
    print(f"the paper's chain: {content['chain']['within_one_level_pct']:.3f} % of the pixels within one grey level of the reference")


@app.command("growth")
def growth(
    minutes: Annotated[float, typer.Option(min=0.1, metavar="MIN", help="Length of the walk.")] = 10.0,
    keypoints: Annotated[int, typer.Option(min=100, metavar="N", help="Keypoints of a frame, about.")] = 300,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for growth.json and growth.png. Default: runs/growth_TIME.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter; repeatable. `thegra config` lists them.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Time tracking and mapping while the map grows: a walk through new places, made of points instead of images.

    Example: `thegra benchmark growth --minutes 10 --out runs/growth`
    """
    from rich.console import Console
    from rich.progress import Progress

    from thegra_core.config import load_config, parse_assignments
    from thegra_core.evaluation.benchmark import growth as logic

    config = load_config("quality", overrides={"preprocessing.filters": "[]"} | parse_assignments(set_ or ()))
    folder = out or Path("runs") / f"growth_{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}"
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("walking", total=None)
        samples = logic.walk(config, minutes, keypoints, lambda done, total: bar.update(task, completed=done, total=total))
    logic.write(samples, folder)
    told = logic.summary(samples)
    if as_json:
        print(json.dumps(told, indent=2))
        return
    for name, value in told.items():
        print(f"{name:18} {value}")
    print(f"figure             {folder / 'growth.png'}")


@app.command("places")
def places(
    recordings: Annotated[list[Path] | None, typer.Argument(metavar="[INPUT...]", help="Recordings as `thegra run` takes them, each of a scene of its own.")] = None,
    suite: Annotated[bool, typer.Option("--suite", help="Also the fixed simulated suite; what is missing of it is made first.")] = False,
    suite_dir: Annotated[Path, typer.Option(metavar="DIR", help="Where the suite is kept.")] = Path("runs/suite"),
    only: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Of the suite only this sequence; repeatable.")] = None,
    check: Annotated[list[str] | None, typer.Option(metavar="CHECK", help="pairs: two recordings joined; back: one and its way back; turned: one, half a turn about the optical axis at its end, and the way back upside down, for cameras that look at the ground; between: one, another, and the first one's way back; kidnapped: a map of each, shown frames of its own and of all others. Repeatable. Default: all but turned.")] = None,
    profile: Annotated[str, typer.Option(help="paper, quality, fast or realtime.")] = "quality",
    every: Annotated[int, typer.Option(min=1, metavar="N", help="Use every N-th frame.")] = 1,
    max_frames: Annotated[int | None, typer.Option("--max-frames", min=2, metavar="N", help="Frames of each recording at the most.")] = None,
    trials: Annotated[int, typer.Option(min=1, metavar="N", help="Times that the camera is set down in its own map.")] = 20,
    shown: Annotated[int, typer.Option(min=1, metavar="N", help="Frames of each other recording that a map is shown.")] = 20,
    gap: Annotated[float, typer.Option(min=0.0, metavar="S", help="Seconds without a frame between the recordings.")] = 0.0,
    cache: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the networks' results there.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for results.json, results.md and thegra.log. Default: runs/places_TIME.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter for all runs; repeatable. `thegra config` lists them.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print results.json instead of the table.")] = False,
) -> None:
    """Tell whether places are told apart and found again: in joined recordings, and by a camera that is set down somewhere.

    Example: `thegra benchmark places --suite --profile fast --every 2 --cache runs/cache`

    Exit code: 0 all right, 1 some place was taken for another or not found again, 2 wrong use.
    """
    import logging

    from rich.console import Console

    from thegra_core.cli.run import cached_front_end, log_file
    from thegra_core.config import load_config, parse_assignments
    from thegra_core.evaluation.benchmark import places as logic
    from thegra_core.evaluation.benchmark.settings import Settings
    from thegra_core.process import set_threads
    from thegra_core.sources.joined import read_clip

    config = load_config(profile, overrides=parse_assignments(set_ or ()))
    set_threads(config.threads)
    plan = logic.Plan(tuple(check or logic.USUAL), gap, trials, shown, tuple(set_ or ()))
    paths = [*(recordings or ()), *(_suite(suite_dir, only) if suite else [])]
    if not paths:
        raise InputError("nothing to join: name recordings, or add --suite for the simulated ones")
    target = out or Path("runs") / f"places_{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}"
    with Console(stderr=True).status("reading") as status, log_file(target):
        clips = {clip.name: clip for clip in (read_clip(path, every, max_frames) for path in paths)}

        def say(what: str) -> None:
            status.update(what)
            logging.getLogger(__name__).info("%s", what)

        content = logic.benchmark(clips, plan, Settings(config, *cached_front_end(config, cache)), target, say)
    print(json.dumps(content, indent=2, allow_nan=False) if as_json else logic.markdown(content))
    if logic.wrong(content):
        raise typer.Exit(SOME_FAILED)


def _frames_of(recordings: Sequence[Path], count: int) -> list[ImageArray]:
    import numpy as np

    from thegra_core.simulation.simulate import SimulationOptions, rendered
    from thegra_core.sources.open import open_recording

    if not recordings:
        ticks = rendered(SimulationOptions(duration_s=float(count), rate_hz=1.0)).ticks
        return [tick.image for tick in ticks if tick.image is not None]
    chosen: list[ImageArray] = []
    for path in recordings:
        recording = open_recording(path)
        total = sum(1 for _ in recording.frames())  # read twice, so that a long recording need not fit in memory
        wanted = set(np.linspace(0, total - 1, count).round().astype(int).tolist()) if total else set()
        chosen += [frame.image for i, frame in enumerate(recording.frames()) if i in wanted]
    if not chosen:
        raise InputError("the recordings hold no readable image; what they hold is told by: thegra info INPUT")
    return chosen


def _suite(folder: Path, names: Sequence[str] | None) -> list[Path]:
    """The simulated recordings, made with a bar where they are missing."""
    from rich.console import Console

    from thegra_core.evaluation.suite import SUITE, make_suite

    unknown = next((name for name in names or () if name not in SUITE), None)
    if unknown is not None:
        raise ConfigError(f"--only {unknown}: the suite has no such sequence; it has {', '.join(SUITE)}")
    with Console(stderr=True).status("looking for the suite") as status:
        return make_suite(folder, names or None, lambda name, done, total: status.update(f"simulating {name}: {done} of {total} frames"))


def _limits(texts: list[str]) -> dict[str, int]:
    limits: dict[str, int] = {}
    for text in texts:
        name, _, count = text.rpartition("=")
        if not name or not count.isdecimal() or int(count) == 0:
            raise ConfigError(f"--max-frames {text}: write NAME=N with the recording's name and a number of frames, e.g. --max-frames flight=100")
        limits[name] = int(count)
    return limits


def _show(content: dict[str, Any], out: Path, as_json: bool) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from thegra_core.evaluation.benchmark.comparison import sentences
    from thegra_core.evaluation.benchmark.tables import caption, failures, table

    for failure in failures(content):
        typer.echo(f"failed: {failure}", err=True)
    if as_json:
        print(json.dumps(content, indent=2, allow_nan=False))
        return
    header, rows = table(content)
    shown = Table(caption=escape(caption(content)), caption_justify="left")
    for name in header:
        shown.add_column(name, overflow="fold")
    for row in rows:
        shown.add_row(*map(escape, row))
    console = Console(highlight=False)
    console.print(shown)
    for sentence in sentences(content["comparisons"]):
        console.print(sentence, markup=False)
    console.print(f"results  {out / 'results.json'}\ntable    {out / 'results.md'}", soft_wrap=True, markup=False)
