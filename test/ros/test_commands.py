"""`thegra live` and `thegra play` as a user types them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.errors import ConfigError
from thegra_ros.live import LiveOptions, ros_arguments

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_ROS = """
import sys
sys.modules["rclpy"] = None
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name.split(".")[0] == "rclpy" else find(name, *rest)
from thegra_core.cli.main import main
sys.argv = ["thegra", *{arguments!r}]
main()
"""


@pytest.mark.parametrize("arguments", [["live"], ["play", "flight.mcap"]])
def test_without_ros_the_commands_say_what_to_install(arguments: list[str]) -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_ROS.format(arguments=arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "pip install" in done.stderr and "source /opt/ros" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("command", ["live", "play"])
def test_help_shows_an_example(command: str) -> None:
    shown = CliRunner().invoke(app, [command, "--help"])
    assert shown.exit_code == 0 and f"thegra {command} " in shown.output


def test_options_become_ros_arguments(tmp_path: Path) -> None:
    camera = tmp_path / "camera.yaml"
    camera.write_text("")
    options = LiveOptions("boson/image_raw", camera, "fast", None, "uav1", ("--ros-args", "-r", "__ns:=/mine"))
    arguments = ros_arguments(options)
    assert arguments[:3] == ["--ros-args", "-r", "__ns:=/mine"], "the user's own remapping comes first, and the first wins"
    assert "__ns:=/uav1" in arguments and "image_raw:=/boson/image_raw" in arguments and "camera_info:=/boson/camera_info" in arguments
    assert "image_raw/compressed:=/boson/image_raw/compressed" in arguments, "remapping rules match whole names"
    assert f"camera_file:={camera}" in arguments and "profile:=fast" in arguments


def test_what_is_not_understood_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--ros-args"):
        ros_arguments(LiveOptions(extra=("--speed", "2")))
    with pytest.raises(ConfigError, match=r"none\.yaml does not exist"):
        ros_arguments(LiveOptions(config=tmp_path / "none.yaml"))


def test_when_one_node_ends_the_others_do() -> None:
    """In a process of its own, for its handling of signals."""
    code = """
import sys
from thegra_ros.live import supervise
forever = [sys.executable, "-c", "import signal; signal.pause()"]
sys.exit(supervise([forever, [sys.executable, "-c", "raise SystemExit(7)"]]))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=120).returncode == 7


def test_nodes_end_with_whoever_started_them() -> None:
    node = """
import ctypes, os
from thegra_ros.environment import end_with_supervisor
end_with_supervisor()
os.write(1, b"computes\\n")  # in one piece, whatever else is written there
ctypes.PyDLL(None).sleep(10**6)  # and holds Python's lock
"""
    code = "import sys; from thegra_ros.live import supervise; supervise([[sys.executable, '-c', sys.argv[1]]] * 2)"
    with subprocess.Popen([sys.executable, "-c", code, node], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        heard = [parent.stdout.readline() for _ in range(2)]
        parent.kill()
        assert heard == [b"computes\n"] * 2
        assert parent.stdout.read() == b"", "both held the other end, and are gone"
