"""The commands `thegra live` and `thegra play`. This module imports no ROS, so that `thegra --help` works without it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from thegra_core.errors import ThegraError

_MISSING = """{command} needs ROS 2 (rclpy), which this Python does not find
with ROS 2 installed:   source /opt/ros/jazzy/setup.bash
without, on x86-64:     pip install "ros-jazzy-rclpy[fastrtps]" ros-jazzy-common-interfaces ros-jazzy-lifecycle-msgs ros-jazzy-rosgraph-msgs
a recording needs none: thegra run RECORDING"""


class RosError(ThegraError):
    """ROS 2 is not there."""


def live(
    context: typer.Context,
    image: Annotated[str | None, typer.Option(metavar="TOPIC", help="The camera's image topic; camera_info is taken from beside it. Default: image_raw in the namespace.")] = None,
    camera: Annotated[Path | None, typer.Option(metavar="FILE", help="Camera calibration; wins over camera_info.")] = None,
    profile: Annotated[str | None, typer.Option(help="paper, quality, fast or realtime. Default: what the file of --config names, else realtime.")] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML with parameters; a run's config.yaml will do.")] = None,
    namespace: Annotated[str, typer.Option(help="Namespace of nodes and topics.")] = "thegra",
    single_process: Annotated[bool, typer.Option("--single-process/--stages", help="One node for the whole system, or one for each of its four stages.")] = True,
) -> None:
    """Track a live camera: images on a ROS 2 topic in, pose, path and map out.

    Example: `thegra live --image /camera/image_raw`

    What ROS understands may follow: `--ros-args -p base_frame:=base_link -p scale:=2.0`. Ends with Ctrl-C.
    """
    need_ros("thegra live")
    from thegra_ros.live import LiveOptions
    from thegra_ros.live import live as run

    raise typer.Exit(run(LiveOptions(image, camera, profile, config, namespace, tuple(context.args), single_process)))


def play(
    context: typer.Context,
    recording: Annotated[Path, typer.Argument(metavar="INPUT", help="Whatever `thegra run` reads.")],
    topic: Annotated[str | None, typer.Option(help="Image topic of a bag; guessed when only one fits.")] = None,
    camera: Annotated[str | None, typer.Option(metavar="FILE", help="Camera calibration. Default: the recording's own.")] = None,
    rate: Annotated[float, typer.Option(help="Times as fast as recorded.", min=1e-3)] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end, with the same stamps.")] = False,
    clock: Annotated[bool, typer.Option("--clock", help="Publish the recording's time on /clock, for nodes with use_sim_time.")] = False,
    wait: Annotated[float, typer.Option(metavar="S", min=0.0, help="Seconds to wait at the most for someone to listen.")] = 5.0,
    max_frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    namespace: Annotated[str, typer.Option(help="Namespace of image_raw and camera_info.")] = "thegra",
) -> None:
    """Play a recording onto image_raw and camera_info, as a camera would, with the stamps it was recorded with.

    Example: `thegra play flight.mcap --rate 0.5 --loop`
    """
    need_ros("thegra play")
    from thegra_ros.play import PlayOptions
    from thegra_ros.play import play as run

    raise typer.Exit(run(PlayOptions(recording, topic, camera, rate, loop, clock, wait, max_frames, namespace, tuple(context.args))))


def need_ros(command: str) -> None:
    """Refuse a command where ROS 2 is missing.

    Raises:
        RosError: With what to install.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise RosError(_MISSING.format(command=command))
