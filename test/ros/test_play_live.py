"""`thegra play` into `thegra live`: two processes that only share topics."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import signal
import subprocess
import sys
from pathlib import Path

from ros_graph import EVERY_IMAGE, FAST, IN_STEP, LIMIT_S, Graph
from rosgraph_msgs.msg import Clock

from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.qos import LOSSLESS

THEGRA = [sys.executable, "-m", "thegra_core.cli.main"]
PARAMETERS = [argument for name, value in (FAST | EVERY_IMAGE | IN_STEP).items() if name != "profile" for argument in ("-p", f"{name}:={value}")]


@pytest.mark.slow
def test_a_recording_is_played_and_tracked(graph: Graph, recording_path: Path, frames, tmp_path: Path) -> None:
    clock = graph.listen(Clock, "/clock", LOSSLESS)
    played = {frame.stamp_ns for frame in frames}
    live_log, play_log = (tmp_path / "live.log").open("w"), (tmp_path / "play.log").open("w")
    live = subprocess.Popen([*THEGRA, "live", "--profile", "fast", "--ros-args", *PARAMETERS, "-p", "use_sim_time:=true"],
                            env=graph.environment, stdout=live_log, stderr=subprocess.STDOUT)  # fmt: skip
    play = subprocess.Popen([*THEGRA, "play", str(recording_path), "--rate", "0.5", "--clock", "--wait", str(LIMIT_S)], env=graph.environment, stdout=play_log, stderr=subprocess.STDOUT)
    try:
        graph.wait(lambda: len(graph.received["pose"]) > 10, "poses")
        graph.wait(lambda: play.poll() is not None and any(stamp_ns(m.clock) == max(played) for m in clock), "the end of the recording")
        assert play.returncode == 0
        live.send_signal(signal.SIGINT)
        assert live.wait(LIMIT_S) == 0
    finally:
        for process in (live, play):
            if process.poll() is None:
                process.kill()
                process.wait()
        live_log.close()
        play_log.close()
    assert {stamp_ns(m) for m in graph.received["pose"]} <= played, "results have the stamps of the images"
    assert all(min(played) <= stamp_ns(m.clock) <= max(played) for m in clock)
    assert f"{len(frames)} images played" in (tmp_path / "play.log").read_text()


@pytest.mark.slow
def test_playing_ends_with_a_signal(graph: Graph, recording_path: Path) -> None:
    play = subprocess.Popen([*THEGRA, "play", str(recording_path), "--loop", "--wait", "0"], env=graph.environment, stderr=subprocess.PIPE, text=True)
    try:
        assert play.stderr is not None
        while "turn 2" not in play.stderr.readline():
            assert play.poll() is None
        play.send_signal(signal.SIGTERM)
        assert play.wait(LIMIT_S) == 0
    finally:
        play.kill()
        play.communicate()
