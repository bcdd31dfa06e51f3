"""The command `thegra`: one sub-command a task; the work is imported only when its command runs."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from thegra_core.cli import exit_codes
from thegra_core.cli.benchmark import app as benchmark_app
from thegra_core.cli.extensions import BENCHMARKS, add_commands
from thegra_core.cli.weights import app as weights_app
from thegra_core.errors import ThegraError
from thegra_core.process import keep_freed_memory
from thegra_core.version import VERSION


class Pieces(str, Enum):
    """How recordings in several bag files are run."""

    BAGS = "bags"
    WHOLE = "whole"
    WINDOWS = "windows"


class ReferenceChoice(str, Enum):
    """Which of several references to score against."""

    AUTO = "auto"
    LOAM = "loam"
    VICON = "vicon"


class Choice(str, Enum):
    """What an ablation compares."""

    WEIGHTING = "weighting"
    CHAIN = "chain"


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
    profile: Annotated[str | None, typer.Option(help="paper, quality, fast or realtime. Default: quality.")] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML with parameters; a run's config.yaml will do.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter, e.g. extractor.max_keypoints=2048; repeatable. `thegra config` lists them.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results. Default: runs/INPUT_TIME.")] = None,
    groundtruth: Annotated[Path | None, typer.Option(metavar="FILE", help="TUM trajectory to score against. Default: the one beside the input, if any.")] = None,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    start: Annotated[float, typer.Option(metavar="S", min=0.0, help="Seconds of the recording to skip.")] = 0.0,
    duration: Annotated[float | None, typer.Option(metavar="S", min=0.0, help="Seconds of the recording to process.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of every random choice. Default: the configuration's, 0.")] = None,
    map_: Annotated[Path | None, typer.Option("--map", metavar="FILE", help="Begin in the map of this file and go on in it.")] = None,
    localization_only: Annotated[bool, typer.Option("--localization-only", help="With --map: find the camera in the map and leave the map as it is.")] = False,
    save_map: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the map to this file at the end, for --map.")] = None,
    realtime: Annotated[bool, typer.Option("--realtime", help="Play the recording at its own rate, as a camera would: what comes too fast is dropped, and mapping has a process of its own. The outcome then depends on the machine.")] = False,
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
        map=map_, localization_only=localization_only, save_map=save_map, realtime=realtime,
    )  # fmt: skip
    raise typer.Exit(run_recording(options))


@app.command("export-models")
def export_models(
    size: Annotated[list[str] | None, typer.Option(metavar="WxH", help="Image size; repeatable. Default: 640x512 and 320x256.")] = None,
) -> None:
    """Write XFeat's network as ONNX files where the backends onnxruntime and openvino look for them.

    Example: `thegra export-models --size 640x512`

    Without this command it is done at the first run with such a backend, which then takes some seconds longer. It needs `pip install onnx onnxscript`.
    """
    from thegra_core.cli.simulate import image_size
    from thegra_core.features.xfeat import export_xfeat

    for text in size or ("640x512", "320x256"):
        typer.echo(export_xfeat(image_size(text)))


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
    max_gap: Annotated[float, typer.Option(metavar="S", min=0.0, help="The ground truth is interpolated in gaps up to this; 0: only its nearest pose, as evo does.")] = 0.5,
    fit_lever_arm: Annotated[bool, typer.Option("--fit-lever-arm", help="Fit the camera's place on the body that the ground truth tells of.")] = False,
    fit_time_offset: Annotated[bool, typer.Option("--fit-time-offset", help="Fit the offset of the ground truth's clock, +-0.5 s, by the rotation rates.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Score a trajectory against ground truth: coverage, ATE and RPE after Sim(3) alignment.

    Example: `thegra score runs/flight/trajectory.txt groundtruth.txt --images images.txt`
    """
    from thegra_core.cli.score import score_command
    from thegra_core.evaluation.scores import Settings

    settings = Settings(tolerance, max_gap, fit_lever_arm, fit_time_offset)
    score_command(trajectory, groundtruth, images, shutter, settings, as_json)


@app.command()
def evaluate(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Where the data set lies; `generic`: YAML lists of recordings.")],
    dataset: Annotated[str, typer.Option(help="vivid, rovtio, tum, euroc, kitti or generic.")],
    runs: Annotated[int, typer.Option(min=1, metavar="N", help="Runs of each, with seeds 0 to N-1.")] = 1,
    profile: Annotated[list[str] | None, typer.Option(help="paper, quality, fast or realtime; repeatable. Default: quality.")] = None,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Runs at a time on this machine.")] = 1,
    dask: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Run on the workers of this Dask scheduler, which must see the same files.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for tables and runs; with the folder of an evaluation, only what is missing is run. Default: runs/evaluate_DATASET.")] = None,
    pieces: Annotated[Pieces, typer.Option(help="rovtio: one run a bag file, whole recordings, or windows of 30 s.")] = Pieces.BAGS,
    reference: Annotated[ReferenceChoice, typer.Option(help="rovtio: loam or vicon; auto: LOAM where it is.")] = ReferenceChoice.AUTO,
    camera: Annotated[str | None, typer.Option(metavar="FILE", help="Calibration for all sequences. Default: the data set's.")] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="NAME", help="This sequence; repeatable. Default: all.")] = None,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Use the first frames of each sequence only.")] = None,
    fit_lever_arm: Annotated[bool, typer.Option("--fit-lever-arm", help="A second ATE with the camera's place on the reference's body fitted.")] = False,
    fit_time_offset: Annotated[bool, typer.Option("--fit-time-offset", help="A second ATE with the reference's clock fitted, +-0.5 s.")] = False,
    cache: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep the networks' results there.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter for all runs; repeatable.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell what is there, and what was decided about topics, cameras and references.")] = False,
) -> None:
    """Run a public data set and print the paper's table with its figures and ours.

    Example: `thegra evaluate --dataset vivid /data/vivid --runs 3 --workers 2 --out runs/vivid`

    Exit code: 0 all ran, 1 some run failed, 2 wrong use or nothing of the data set is there.
    """
    from thegra_core.cli.evaluate import EvaluateOptions
    from thegra_core.cli.evaluate import evaluate as go
    from thegra_core.evaluation.scores import Settings

    options = EvaluateOptions(
        dataset=dataset, folders=tuple(folders), out=out or Path("runs") / f"evaluate_{dataset}", runs=runs, profiles=tuple(dict.fromkeys(profile or ["quality"])), workers=workers,
        dask=dask, pieces=pieces.value, reference=reference.value, camera=camera, only=tuple(only or ()), max_frames=max_frames, cache=cache, assignments=tuple(set_ or ()),
        fits=Settings(fit_lever_arm=fit_lever_arm, fit_time_offset=fit_time_offset), dry_run=dry_run,
    )  # fmt: skip
    raise typer.Exit(go(options))


@app.command()
def ablation(
    inputs: Annotated[list[Path], typer.Argument(metavar="INPUT...", help="Recordings as `thegra run` takes them, with groundtruth.txt beside; with --dataset its folders.")],
    dataset: Annotated[str | None, typer.Option(help="Take the sequences of this data set, as `thegra evaluate` does.")] = None,
    choice: Annotated[list[Choice] | None, typer.Option(help="weighting or chain; repeatable. Default: both.")] = None,
    profile: Annotated[str, typer.Option(help="paper, quality, fast or realtime: what the choices are made in.")] = "quality",
    runs: Annotated[int, typer.Option(min=1, metavar="N", help="Runs of each, with seeds 0 to N-1.")] = 1,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Runs at a time on this machine.")] = 1,
    dask: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Run on the workers of this Dask scheduler, which must see the same files.")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for tables, pictures and runs; what is there already is not run again.")] = Path("runs/ablation"),
    camera: Annotated[str | None, typer.Option(metavar="FILE", help="Calibration for all. Default: the recording's own.")] = None,
    cache: Annotated[Path | None, typer.Option(metavar="DIR", help="Where the networks' results are kept. Default: cache in the folder for the results.")] = None,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Use the first frames of each recording only.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter for all runs; repeatable.")] = None,
) -> None:
    """Compare the weights of the observations (the paper's Table III) and the filters by coverage and error.

    Example: `thegra ablation recordings/* --runs 3 --workers 2 --out runs/ablation`

    Writes ablation.md, ablation.csv, weighting.png and chain.png. Exit code: 0 all ran, 1 some run failed, 2 wrong use.
    """
    from thegra_core.cli.ablation import AblationOptions
    from thegra_core.cli.ablation import ablation as go

    options = AblationOptions(
        inputs=tuple(inputs), out=out, dataset=dataset, groups=tuple(c.value for c in dict.fromkeys(choice or Choice)), profile=profile, runs=runs, workers=workers, dask=dask,
        camera=camera, cache=cache, max_frames=max_frames, assignments=tuple(set_ or ()),
    )  # fmt: skip
    raise typer.Exit(go(options))


@app.command()
def config(
    profile: Annotated[str | None, typer.Option(help="paper, quality, fast or realtime. Default: quality.")] = None,
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


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(metavar="DIR", help="New folder for the recording.")],
    scene: Annotated[str | None, typer.Option(help="room, corridor, street or tunnel. Default: room.")] = None,
    style: Annotated[str | None, typer.Option(help="How the camera is carried: robust, unstable or aggressive. Default: robust.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Seconds. Default: once round the scene and a little more.")] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Frames a second. Default: 10.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size. Default: 640x512.")] = None,
    shutter: Annotated[str | None, typer.Option(help="none, gap (no frames while it is closed) or freeze (the last frame again). Default: none.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of scene, path and sensor. Default: 0.")] = None,
    source: Annotated[Path | None, typer.Option("--from", metavar="FOLDER", help="A recording whose images pass through the simulated sensor in place of a scene.")] = None,
    format_: Annotated[str, typer.Option("--format", help="mcap, folder, vivid or rovtio (ROS 1 bags as in those sets).")] = "mcap",
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter of the sensor, e.g. netd_mk=40; repeatable. docs/simulator.md lists them.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> None:
    """Make a simulated thermal recording with exact ground truth.

    Example: `thegra simulate --scene corridor --style unstable --shutter gap --out bags/corridor`
    """
    from thegra_core.cli.simulate import simulate_command

    values = {"scene": scene, "style": style, "duration_s": duration, "rate_hz": rate, "shutter": shutter, "seed": seed, "source": source}
    simulate_command(values, size, set_ or (), format_, out, quiet)


app.add_typer(weights_app, name="weights")
app.add_typer(benchmark_app, name="benchmark")
add_commands(app)
add_commands(benchmark_app, BENCHMARKS)


if __name__ == "__main__":
    main()
