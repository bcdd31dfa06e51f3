"""What the benchmarks compute; and that they run."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import json
import os
import subprocess
import sys
from pathlib import Path

from ros_graph import FAST, LIMIT_S

from thegra_core.errors import InputError
from thegra_core.evaluation.benchmark.memory import descendants, resident_mb
from thegra_ros.benchmark.latency import Alone, compare, unhindered
from thegra_ros.benchmark.soak import Plan, Sample, summary

LIGHT = {**FAST, "flow.enabled": "true", "tracking.match_by": "nearest"}
"""With these there is a map after a few frames, also on a machine that does much besides."""
SET = [argument for name, value in LIGHT.items() if name != "profile" for argument in ("--set", f"{name}={'[{filter: he_clip}]' if name == 'preprocessing.filters' else value}")]


def test_overhead_is_the_difference_frame_by_frame() -> None:
    """One frame is slow in both: medians of each would hide what it costs."""
    alone = {1: Alone(10.0, False), 2: Alone(100.0, False), 3: Alone(10.0, False), 4: Alone(90.0, True), 9: Alone(1.0, False)}
    alone |= {5: Alone(10.0, False), 6: Alone(80.0, True)}  # keyframes by one of the ways
    found = compare("one process", alone, {1: 12.0, 2: 103.0, 3: 14.0, 4: 97.0, 5: 60.0, 6: 12.0, 7: 5.0}, {4, 5})
    assert (found.frames, found.direct_ms, found.ros_ms, found.overhead_ms, found.target_ms) == (3, 10.0, 14.0, 3.0, 5.0)
    assert (found.keyframes, found.keyframe_overhead_ms) == (1, 7.0)
    with pytest.raises(InputError, match="--rate"):
        compare("one process", alone, {4: 97.0, 5: 60.0, 8: 1.0}, {4, 5})


def test_frames_that_waited_for_the_one_before_are_left_out() -> None:
    sent = {1: 0.0, 2: 1.0, 3: 2.0, 4: 3.0}
    received = {1: 0.5, 2: 2.5, 3: 2.7}
    assert unhindered(sent, received) == pytest.approx({1: 500.0, 2: 1500.0}), "3 found 2 in work; 4 has no pose"
    assert unhindered({1: 0.0, 2: 1.0}, {2: 1.5}) == {}, "whether 1 was done is not known"


@pytest.mark.parametrize(("per_s", "grown"), [(0.0, 0.0), (1.0, 24.0 / 1.12)])
def test_growth_is_told_after_the_warm_up(per_s: float, grown: float) -> None:
    """Half a minute; the first six seconds, in which networks are loaded, do not count."""
    samples = [Sample(float(t), 10.0 if t < 6 else 106.0 + per_s * t, 15 * t, t, "tracking" if t > 17 else "lost") for t in range(31)]
    told = summary(samples, Plan(0.5, 6.0, 15.0, 10.0, "one process"))
    assert told["growth_pct"] == pytest.approx(grown, abs=0.01)
    assert (told["images"], told["dropped"], told["tracking_pct"]) == (450, 30, 52.0)


def test_memory_is_that_of_a_process_with_its_children() -> None:
    code = "import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', 'x = bytearray(50 << 20); print(1, flush=True); input()'], stdin=subprocess.PIPE); p.wait()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None and parent.stdout.readline()
        children = descendants(parent.pid)
        assert len(children) == 1 and resident_mb(parent.pid) > 50
        os.kill(children[0], 9)
    assert resident_mb(parent.pid) == 0.0


@pytest.mark.slow
def test_the_latency_of_both_graphs_is_measured(recording_path: Path) -> None:
    command = [sys.executable, "-m", "thegra_core.cli.main", "benchmark", "ros", str(recording_path), "--rate", "2", "--json", *SET]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=2 * LIMIT_S)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert [row["graph"] for row in told["graphs"]] == ["one process", "four processes"]
    assert all(row["frames"] > 0 and row["ros_ms"] > 0 for row in told["graphs"])


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("minutes", "warm_up_s"), [(3, 90), pytest.param(10, 120, marks=pytest.mark.skipif("THEGRA_LONG_SOAK" not in os.environ, reason="set THEGRA_LONG_SOAK=1 for the ten minutes"))])
def test_memory_stays_over_many_turns(recording_path: Path, minutes: int, warm_up_s: int) -> None:
    command = [sys.executable, "-m", "thegra_core.cli.main", "benchmark", "soak", str(recording_path), "--minutes", str(minutes), "--warm-up", str(warm_up_s), "--rate", "5", "--json", *SET]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    told = json.loads(done.stdout)
    turns = done.stderr.count("a new map begins")
    assert turns > 5 and told["images"] > 100
    assert told["tracking_pct"] > 20, "a system that has no map tells nothing about the memory of one"
    assert told["growth_pct"] < told["most_growth_pct"]
