"""`thegra live`: the node without a launch system."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from thegra_core.errors import ConfigError
from thegra_core.lifeline import Lifeline
from thegra_core.process import keep_freed_memory
from thegra_ros.environment import LIFELINE_VARIABLE, use_large_segments

STAGES = ("preprocessing", "frontend", "tracking", "mapping")
POLL_S = 0.1
PATIENCE_S = 2.5
"""How long the nodes may take to end, all together."""


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """The command's options; None: not given. `extra` goes to ROS as it is."""

    image: str | None = None
    camera: Path | None = None
    profile: str | None = None
    config: Path | None = None
    namespace: str = "thegra"
    extra: tuple[str, ...] = ()
    single_process: bool = True


def live(options: LiveOptions) -> int:
    """Run until told to end; the exit code.

    Raises:
        ConfigError: If a file does not exist or the arguments are not understood.
    """
    arguments = ros_arguments(options)
    use_large_segments()
    if not options.single_process:
        return supervise([[sys.executable, "-m", f"thegra_ros.nodes.{name}", *arguments] for name in STAGES])
    keep_freed_memory()
    from thegra_ros.lifecycle import run_node
    from thegra_ros.nodes.slam import SlamNode

    return run_node(SlamNode, arguments)


def supervise(commands: list[list[str]]) -> int:
    """Run nodes until told to end, or until one of them ends, which ends the others; 0, or the code of the one that ended first.

    Where this process is killed its nodes end as well.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _interrupt)
    lines = [Lifeline() for _ in commands]  # one each: whom the end is told is a property of the pipe
    processes = [
        subprocess.Popen(command, env={**os.environ, LIFELINE_VARIABLE: str(line.fd)}, pass_fds=[line.fd])
        for command, line in zip(commands, lines, strict=True)
    ]
    for line in lines:
        line.handed_over()
    try:
        while all(process.poll() is None for process in processes):
            time.sleep(POLL_S)
        return next((process.returncode for process in processes if process.returncode), 0)
    except KeyboardInterrupt:
        return 0
    finally:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
        for process in processes:
            process.terminate()
        end = time.monotonic() + PATIENCE_S
        for process in processes:
            try:
                process.wait(max(0.0, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def ros_arguments(options: LiveOptions) -> list[str]:
    """The options as ROS arguments; the user's own come first, which is what wins among remappings.

    Raises:
        ConfigError: If a file does not exist, or an argument is neither the command's nor behind --ros-args.
    """
    extra = list(options.extra)
    if extra and extra[0] != "--ros-args":
        raise ConfigError(f"{extra[0]} is not understood: see thegra live --help; what is for ROS goes behind --ros-args")
    arguments = [*(extra or ["--ros-args"]), "-r", f"__ns:=/{options.namespace.strip('/')}"]
    if options.image is not None:
        topic = "/" + options.image.strip("/")
        names = {"image_raw": topic, "image_raw/compressed": f"{topic}/compressed", "camera_info": f"{topic.rsplit('/', 1)[0]}/camera_info"}
        arguments += [argument for mine, theirs in names.items() for argument in ("-r", f"{mine}:={theirs}")]
    for name, file in (("camera_file", options.camera), ("config_file", options.config)):
        if file is not None:
            if not file.is_file():
                raise ConfigError(f"{file} does not exist")
            arguments += ["-p", f"{name}:={file.resolve()}"]
    if options.profile is not None:
        arguments += ["-p", f"profile:={options.profile}"]
    return arguments
