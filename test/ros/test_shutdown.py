"""A node ends when it is told to, whatever is in work, and leaves no process behind."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ros_graph import OFFLINE, Graph, NodeProcess, children
from sensor_msgs.msg import PointCloud2

from thegra_core.config import load_config
from thegra_core.evaluation.benchmark.memory import descendants
from thegra_core.messages import InitialMap, Keyframe
from thegra_core.slam import Slam
from thegra_ros.codec.records import Assembler, initial_map_tables, keyframe_tables, record_clouds, word
from thegra_ros.codec.stamps import header
from thegra_ros.qos import LOSSLESS

OWN_PROCESSES = {"engine": "process"}


@pytest.fixture
def stopped() -> Iterator[list[int]]:
    """Processes that the test has stopped; none is left over, whatever fails."""
    pids: list[int] = []
    yield pids
    for pid in pids:
        if runs(pid):
            os.kill(pid, signal.SIGKILL)


def runs(pid: int) -> bool:
    """Whether there is such a process, and it has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def stop(pid: int, stopped: list[int]) -> None:
    """From here on its work does not end."""
    stopped.append(pid)
    os.kill(pid, signal.SIGSTOP)


def end(graph: Graph, node: NodeProcess, number: int, pids: Sequence[int]) -> None:
    """End a node by a signal, and see that its processes have ended, too."""
    if number == signal.SIGKILL:
        graph.forget(node)
    else:
        assert node.end(number) == 0
    graph.wait(lambda: not any(map(runs, pids)), f"the end of {pids}")


MAPPING_OF_SLAM = "thegra_core.mapping.process"


def slam_at_work(graph: Graph, frames, camera) -> NodeProcess:
    """The node with more images than it has worked on."""
    node = graph.start(parameters=OWN_PROCESSES)
    graph.wait_for_listener()
    graph.send_camera(camera)
    to_and_fro = [*frames, *frames[-2::-1]]
    graph.send([replace(frame, stamp_ns=frames[0].stamp_ns + 10**8 * count) for count, frame in enumerate(to_and_fro)])
    graph.wait(lambda: graph.processed() >= 10)
    return node


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("endless", [False, True], ids=["at work", "with work that does not end"])
def test_slam_ends_with_its_processes(graph: Graph, frames, camera, stopped: list[int], number: int, endless: bool) -> None:
    node = slam_at_work(graph, frames, camera)
    pids = descendants(node.process.pid)
    assert len(pids) >= 2, "the system's process, and mapping's"
    if endless:
        (mapping,) = (pid for pid in pids if MAPPING_OF_SLAM in Path(f"/proc/{pid}/cmdline").read_text())
        stop(mapping, stopped)
    end(graph, node, number, pids)
    assert graph.processed() < 2 * len(frames) - 1, "there was work left"


@pytest.fixture(scope="module")
def records(frames, camera) -> list[InitialMap | Keyframe]:
    """What tracking hands to mapping, from an offline run."""
    slam = Slam(camera, load_config("fast", overrides={**OFFLINE, "keyframe.translation_ratio": 0.001}))
    kept: list[InitialMap | Keyframe] = []

    def keeping(hand_over: Any) -> Any:
        def keep(record: InitialMap | Keyframe) -> None:
            kept.append(record)
            hand_over(record)

        return keep

    for name in ("initialize", "insert"):
        setattr(slam._mapping, name, keeping(getattr(slam._mapping, name)))
    for frame in frames:
        slam.process(frame)
    assert isinstance(kept[0], InitialMap) and len(kept) > 10
    return kept


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("endless", [False, True], ids=["at work", "with work that does not end"])
def test_mapping_ends_with_its_process(graph: Graph, records: list[InitialMap | Keyframe], camera, stopped: list[int], number: int, endless: bool) -> None:
    node = graph.start("thegra_ros.nodes.mapping", OWN_PROCESSES)
    answers = graph.listen(PointCloud2, "map_update", LOSSLESS)
    keyframes = graph.node.create_publisher(PointCloud2, "keyframe", LOSSLESS)

    def kinds() -> list[str]:
        assembler = Assembler()
        return [record[0] for cloud in answers if (record := assembler.add(cloud)) is not None]

    def send(kind: str, tables: list[Any]) -> None:
        for cloud in record_clouds(header(records[0].keyframes[0].stamp_ns, "thermal_camera"), kind, tables):
            keyframes.publish(cloud)

    graph.wait(lambda: keyframes.get_subscription_count() > 0 and bool(graph.received["/diagnostics"]), "mapping")
    graph.send_camera(camera, "mapping")
    asked = iter(range(1000))
    while not answers:
        send("begin", [word({"question": str(next(asked)), "beginning": "fresh"})])
        graph.spin_until(lambda: bool(answers), 2.0)
    for record in records:
        send(*("initial_map", initial_map_tables(record)) if isinstance(record, InitialMap) else ("keyframe", keyframe_tables(record)))
    graph.wait(lambda: "update" in kinds(), "the first answer")
    pids = descendants(node.process.pid)
    if endless:
        stop(*children(node.process.pid), stopped)
    end(graph, node, number, pids)
    assert kinds().count("update") < len(records), "there was work left"


COMPUTES = """
import ctypes, sys, threading
from thegra_ros.lifecycle import ManagedNode, run_node

class Busy(ManagedNode):
    def __init__(self):
        super().__init__("busy")

    def configure(self):
        # a library that computes for long, and cannot be told to stop
        threading.Thread(target=ctypes.CDLL(None).sleep, args=(10**6,), daemon=True).start()
        print("computes", flush=True)
        if "--fail" in sys.argv:
            raise RuntimeError("cannot be configured")

    def release(self):
        if "--hang" in sys.argv:
            ctypes.CDLL(None).sleep(10**6)

sys.exit(run_node(Busy, []))
"""


@pytest.mark.parametrize(("how", "code"), [((), 0), (("--hang",), 0), (("--fail",), 2)])
def test_what_cannot_be_told_to_stop_keeps_no_node_alive(graph: Graph, how: tuple[str, ...], code: int) -> None:
    with subprocess.Popen([sys.executable, "-c", COMPUTES, *how], env=graph.environment, stdout=subprocess.PIPE) as node:
        assert node.stdout is not None
        assert node.stdout.readline() == b"computes\n"
        if not code:
            node.terminate()
        assert node.wait() == code


WAITS = """
import os, sys
import thegra_ros.lifecycle as lifecycle

last_words_s, chosen = sys.argv[1:]

def wait_in(place):
    if place == chosen:
        os.write(1, b"ends\\n")
        os.read(0, 1)

class Waits(lifecycle.ManagedNode):
    def __init__(self):
        super().__init__("waits")

    def activate(self):
        os.write(1, b"works\\n")

    def release(self):
        wait_in("release")

class Last:
    def __del__(self):
        wait_in("finalization")

_last = Last()  # names with an underscore go first
lifecycle.LAST_WORDS_S = float(last_words_s)
sys.exit(lifecycle.run_node(Waits, []))
"""


def ending(graph: Graph, place: str, last_words_s: float = 60.0) -> subprocess.Popen[bytes]:
    """A node that was told to end and does so, waiting somewhere for a byte that it is sent."""
    command = [sys.executable, "-c", WAITS, str(last_words_s), place]
    node = subprocess.Popen(command, env=graph.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert node.stdout is not None
    assert node.stdout.readline() == b"works\n"
    node.send_signal(signal.SIGINT)
    assert node.stdout.readline() == b"ends\n"
    return node


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("place", ["release", "finalization"])
def test_a_second_signal_changes_nothing(graph: Graph, place: str, number: int) -> None:
    with ending(graph, place) as node:
        node.send_signal(number)
        _, said = node.communicate(b"\n")
    assert node.returncode == 0 and b"Traceback" not in said, said.decode()


def test_more_signals_end_what_hangs(graph: Graph, stopped: list[int]) -> None:
    with ending(graph, "release", last_words_s=1e6) as node:
        stopped.append(node.pid)
        while node.poll() is None:
            node.send_signal(signal.SIGINT)
            graph.spin_for(0.1)
    assert node.returncode == 1
