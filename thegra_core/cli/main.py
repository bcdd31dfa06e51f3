"""The command `thegra`: one sub-command a task; the work is imported only when its command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from thegra_core.cli import exit_codes
from thegra_core.cli.benchmark import app as benchmark_app
from thegra_core.cli.extensions import add_commands
from thegra_core.cli.weights import app as weights_app
from thegra_core.errors import ThegraError
from thegra_core.process import keep_freed_memory
from thegra_core.version import VERSION


class _Group(TyperGroup):
    """Shows errors that the user can do something about as one message instead of a traceback."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except ThegraError as error:
            typer.echo(f"thegra: {error}", err=True)
            raise typer.Exit(exit_codes.WRONG_USE) from error
        except KeyboardInterrupt as error:
            typer.echo("thegra: interrupted", err=True)
            raise typer.Exit(exit_codes.INTERRUPTED) from error


app = typer.Typer(
    name="thegra",
    cls=_Group,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Entry point of the console script."""
    keep_freed_memory()
    app()


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"thegra {VERSION}")
        raise typer.Exit


@app.callback()
def thegra(version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")] = False) -> None:
    """Monocular thermal SLAM: a recording in, a trajectory and a map out.

    Start with: `thegra info recording.bag`, then `thegra run recording.bag`.
    """


@app.command()
def run(
    recording: Annotated[Path, typer.Argument(metavar="INPUT", help="ROS 1 or 2 bag, .mcap, image folder (with images.txt or plain) or video.")],
    topic: Annotated[str | None, typer.Option(help="Image topic; guessed when only one fits.")] = None,
    shutter_topic: Annotated[str | None, typer.Option(help="Topic of a bag with the camera's own shutter state: a boolean (true: closed) or FLIR's FFC state (2: in progress).")] = None,
    camera: Annotated[str | None, typer.Option(metavar="FILE", help="Camera calibration: ROS, Kalibr or OpenCV yaml, or fx,fy,cx,cy. Default: the recording's own.")] = None,
    profile: Annotated[str | None, typer.Option(help="paper, quality or fast. Default: quality.")] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML with parameters; a run's config.yaml will do.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter, e.g. extractor.max_keypoints=2048; repeatable. `thegra config` lists them.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results. Default: runs/INPUT_TIME.")] = None,
    groundtruth: Annotated[Path | None, typer.Option(metavar="FILE", help="TUM trajectory to score against. Default: the one beside the input, if any.")] = None,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    start: Annotated[float, typer.Option(metavar="S", min=0.0, help="Seconds of the recording to skip.")] = 0.0,
    duration: Annotated[float | None, typer.Option(metavar="S", min=0.0, help="Seconds of the recording to process.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of every random choice. Default: the configuration's, 0.")] = None,
    viewer: Annotated[str, typer.Option(help="none, or rerun to watch live.")] = "none",
    cache: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the networks' results there: runs that differ only in seed or back end are then much faster.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors and one final line only.")] = False,
) -> None:
    """Estimate the camera's trajectory and a map from a recording.

    Example: `thegra run flight.mcap --camera camera.yaml --out runs/flight`

    Exit code: 0 done, 1 nothing could be tracked, 2 wrong use or input, 130 interrupted (what is there is written).
    """
    from thegra_core.cli.run import RunOptions, run_recording

    options = RunOptions(
        recording=recording, topic=topic, shutter_topic=shutter_topic, camera=camera, profile=profile, config=config, assignments=tuple(set_ or ()), out=out,
        groundtruth=groundtruth, max_frames=max_frames, start_s=start, duration_s=duration, seed=seed, viewer=viewer, quiet=quiet, cache=cache,
    )  # fmt: skip
    raise typer.Exit(run_recording(options))


@app.command()
def info(
    recording: Annotated[Path, typer.Argument(metavar="INPUT", help="ROS 1 or 2 bag, .mcap, image folder (with images.txt or plain) or video.")],
    topic: Annotated[str | None, typer.Option(help="Image topic to measure; guessed when only one fits.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Tell what a recording holds: topics, images, rate, gaps, calibration, and the command that runs it.

    Example: `thegra info flight.mcap`
    """
    from thegra_core.cli.info import info as tell

    tell(recording, topic, as_json)


@app.command()
def score(
    trajectory: Annotated[Path, typer.Argument(help="TUM file: t tx ty tz qx qy qz qw a line.")],
    groundtruth: Annotated[Path, typer.Argument(help="TUM file to score against.")],
    images: Annotated[Path | None, typer.Option(metavar="FILE", help="List with a stamp first on each line: the frames that count. Default: the ground truth's.")] = None,
    shutter: Annotated[Path | None, typer.Option(metavar="FILE", help="`begin end` of each shutter closure; frames inside are not scored.")] = None,
    tolerance: Annotated[float | None, typer.Option(metavar="S", min=0.0, help="Farthest stamp that belongs to a frame. Default: half a frame period.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Score a trajectory against ground truth: coverage, ATE and RPE after Sim(3) alignment.

    Example: `thegra score runs/flight/trajectory.txt groundtruth.txt --images images.txt`
    """
    from thegra_core.cli.score import score_command

    score_command(trajectory, groundtruth, images, shutter, tolerance, as_json)


@app.command()
def config(
    profile: Annotated[str | None, typer.Option(help="paper, quality or fast. Default: quality.")] = None,
    as_yaml: Annotated[bool, typer.Option("--yaml", help="Print YAML that --config reads.")] = False,
) -> None:
    """List every parameter with value, range, unit and source.

    Example: `thegra config --profile fast --yaml > mine.yaml`
    """
    from thegra_core.cli.config import config_command

    config_command(profile, as_yaml)


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Tell what is installed, which networks, weights and backends are usable: one page to paste in a bug report.

    Example: `thegra doctor --json > doctor.json`
    """
    from thegra_core.cli.doctor import doctor_command

    doctor_command(as_json)


@app.command()
def study(
    recordings: Annotated[list[Path], typer.Argument(metavar="INPUT...", help="Recordings as `thegra run` takes them.")],
    interval: Annotated[float, typer.Option(metavar="SECONDS", min=0.0, help="Time between the frames of a pair; the next frame where frames are further apart.")],
    pairs: Annotated[int, typer.Option(min=1, help="Pairs of each recording at the most.")] = 20,
    chain: Annotated[list[str] | None, typer.Option(help="Filter chain; repeatable. Default: all.")] = None,
    front_end: Annotated[list[str] | None, typer.Option(help="Detector and matcher; repeatable. The first one is used to compare chains. Default: all, SuperPoint + LightGlue first.")] = None,
    cache: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the networks' results there.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for table, CSV and pictures. Default: runs/study_TIME.")] = None,
) -> None:
    """Compare filters and front ends by the matches between frames a fixed time apart: the paper's experiment.

    Example: `thegra study flight.bag --interval 0.5 --front-end "ALIKED + LightGlue" --out runs/study`

    Writes study.csv, study.md, and pictures.
    """
    from datetime import datetime, timezone

    from thegra_core.cli.study import plan_study
    from thegra_core.cli.study import study as run_study

    folder = out or Path("runs") / f"study_{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}"
    run_study(plan_study(recordings, interval, pairs, chain, front_end, cache, folder))


app.add_typer(weights_app, name="weights")
app.add_typer(benchmark_app, name="benchmark")
add_commands(app)


if __name__ == "__main__":
    main()
