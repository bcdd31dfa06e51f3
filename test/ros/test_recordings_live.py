"""Four processes give the trajectory of one, on recordings."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
from ros_graph import OFFLINE, Graph
from stages import Stages

from thegra_core.config import load_config
from thegra_core.messages import TrackingState
from thegra_core.slam import Slam
from thegra_core.sources.open import camera_for, open_recording
from thegra_ros.codec.poses import pose_matrix
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.transforms import Frames, map_pose


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "count"), [("kitchen_rgb_7scenes", 30), ("sim_corridor_loop", 30)])
def test_the_trajectory_is_that_of_one_process(graph: Graph, shared_data: Path, name: str, count: int) -> None:
    """No frame dropped: each is sent when the one before is done. Within 1 % of the path's length, frame by frame."""
    recording = open_recording(shared_data / name)
    frames = [replace(f, stamp_ns=f.stamp_ns + 1000 * 10**9) for f in itertools.islice(recording.frames(), count)]  # some begin at zero
    camera = camera_for(recording, None)
    slam = Slam(camera, load_config("fast", overrides=OFFLINE))
    alone = {r.stamp_ns: map_pose(r.world_from_camera, Frames()) for r in map(slam.process, frames) if r.state is TrackingState.TRACKING}
    stages = Stages(graph, camera, frames[0])
    stages.send(frames)
    graph.wait(lambda: {stamp_ns(m) for m in graph.received["pose"]} >= set(alone), "the poses")
    live = {stamp_ns(m): pose_matrix(m.pose.pose) for m in graph.received["pose"]}
    assert len(alone) > 5 and set(live) == set(alone)
    path = np.array([alone[stamp][:3, 3] for stamp in sorted(alone)])
    apart = max(np.linalg.norm(live[stamp][:3, 3] - pose[:3, 3]) for stamp, pose in alone.items())
    assert apart < 0.01 * np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert stages.end() == [0, 0, 0, 0]
