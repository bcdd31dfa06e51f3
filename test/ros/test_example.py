"""The example node hears what is published."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import subprocess
import sys
from pathlib import Path

import numpy as np
from ros_graph import NAMESPACE, Graph

from thegra_core.geometry.poses import transform
from thegra_core.messages import MapSummary, TrackingResult, TrackingState
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.node_config import NodeConfig
from thegra_ros.outputs import MapOutputs, PoseOutputs
from thegra_ros.transforms import Frames

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "listen.py"


class Speaker(ManagedNode):
    """Publishes a pose and a map of three points."""

    def __init__(self, **options) -> None:
        super().__init__("speaker", **options)

    def configure(self) -> None:
        self._poses, self._map = PoseOutputs(self, Frames(), NodeConfig()), MapOutputs(self)

    def speak(self) -> None:
        pose = transform(np.eye(3), [0.0, 0.0, 1.5])
        self._poses.publish(TrackingResult(10**9, TrackingState.TRACKING, pose, 1e-4 * np.eye(6), np.zeros(6), map_id=0), Frames())
        self._map.publish(10**9, MapSummary(0, np.array([10**9]), pose[None], np.eye(3), np.ones(3, np.float32)), Frames())


def test_the_example_prints_pose_path_and_map(graph: Graph, tmp_path: Path) -> None:
    speaker = graph.add(Speaker)
    assert speaker.start()
    log = tmp_path / "example.log"
    with log.open("w") as out:
        listener = subprocess.Popen([sys.executable, str(EXAMPLE), "--ros-args", "-r", f"__ns:={NAMESPACE}"], env=graph.environment, stdout=out, stderr=subprocess.STDOUT)
        try:
            wanted = ("pose in map: x 1.50 y 0.00 z 0.00, x +-0.010", "path of", "map of 3 points")
            while not all(text in log.read_text() for text in wanted):
                assert listener.poll() is None, log.read_text()
                speaker.speak()
                graph.spin_for(0.3)
        finally:
            listener.kill()
            listener.wait()


def test_the_example_is_short_and_shown() -> None:
    code = EXAMPLE.read_text()
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 25
    assert "examples/listen.py" in (EXAMPLE.parents[1] / "docs" / "ros.md").read_text()
