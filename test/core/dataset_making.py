"""Tiny recordings in the layouts of public data sets, and a runner that needs no networks."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from bag_making import IMAGE, ROS1, T0, Item, header, image_message

from thegra_core.evaluation.tasks import IDENTITY, Outcome, RunTask, finished
from thegra_core.geometry.poses import quaternion_from_rotation, so3_exp
from thegra_core.outputs.trajectory import Trajectory, make_trajectory

ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
PERIOD_NS = 40_000_000


def pose(i: int, upright: bool = False) -> np.ndarray:
    """A walk that turns; `upright`: about the vertical only."""
    result = np.eye(4)
    result[:3, :3] = so3_exp([0, 0, 0.9 + 0.11 * i] if upright else [0.4 * np.sin(0.4 * i), 0.7 * np.cos(0.3 * i), 0.05 * i])
    result[:3, 3] = np.cos(0.2 * i), 0.1 * i, np.sin(0.25 * i)
    return result


def walk(count: int = 20, begin_ns: int = T0, upright: bool = False) -> Trajectory:
    return make_trajectory((begin_ns + i * PERIOD_NS, pose(i, upright)) for i in range(count))


def rows(trajectory: Trajectory, order: str = "xyzw", time: str = "s") -> np.ndarray:
    """Stamp, position, quaternion as text cells (N, 8)."""
    divide = {"s": 10**9, "ns": 1, "us": 10**3, "ms": 10**6}[time]
    cells = []
    for stamp, matrix in zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True):
        x, y, z, w = quaternion_from_rotation(matrix[:3, :3])
        quaternion = [x, y, z, w] if order == "xyzw" else [w, x, y, z]
        whole, rest = divmod(stamp, divide)
        text = f"{whole}" if divide == 1 else f"{whole}.{rest:0{len(str(divide)) - 1}d}"
        cells.append([text, *(f"{v:.9f}" for v in [*matrix[:3, 3], *quaternion])])
    return np.array(cells)


def thermal(topic: str = "/thermal/image_raw", count: int = 3, begin_ns: int = T0, size: tuple[int, int] = (64, 48), encoding: str = "mono16") -> list[Item]:
    """Images every `PERIOD_NS`, received a little later."""
    rng = np.random.default_rng(count)
    images = [rng.integers(2900, 3300, size[::-1]).astype(np.uint16) for _ in range(count)]
    stamps = [begin_ns + i * PERIOD_NS for i in range(count)]
    return [(topic, IMAGE, image_message(ROS1, image, stamp, encoding), stamp + 10**6) for image, stamp in zip(images, stamps, strict=True)]


def odometry(topic: str, trajectory: Trajectory) -> list[Item]:
    types = ROS1.types
    vector = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](vector, vector), np.zeros(36))
    items = []
    for stamp, matrix in zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True):
        x, y, z, w = map(float, quaternion_from_rotation(matrix[:3, :3]))
        inner = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*map(float, matrix[:3, 3])), types["geometry_msgs/msg/Quaternion"](x, y, z, w))
        message = types[ODOMETRY](header(ROS1, stamp, "map"), "lidar", types["geometry_msgs/msg/PoseWithCovariance"](inner, np.zeros(36)), twist)
        items.append((topic, ODOMETRY, message, stamp + 10**6))
    return items


def transforms(topic: str, trajectory: Trajectory) -> list[Item]:
    types, items = ROS1.types, []
    for stamp, matrix in zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True):
        x, y, z, w = map(float, quaternion_from_rotation(matrix[:3, :3]))
        inner = types["geometry_msgs/msg/Transform"](types["geometry_msgs/msg/Vector3"](*map(float, matrix[:3, 3])), types["geometry_msgs/msg/Quaternion"](x, y, z, w))
        items.append((topic, TRANSFORM, types[TRANSFORM](header(ROS1, stamp, "vicon"), "charlie", inner), stamp + 10**6))
    return items


def metrics(**changed: Any) -> dict[str, Any]:
    """Those of a run that a made result is read from."""
    base = {
        "frames_total": 20, "tracked_pct": 100.0, "tracked_until_loss_pct": 100.0, "losses": 0, "maps": 1, "keyframes": 4, "loops": 0, "ate_rmse": 0.1, "ate_live_rmse": 0.2,
        "ate_rel": 0.05, "ate_pct": 1.0, "ate_scale": 2.0, "ate_pairs": 20, "ate_pairs_pct": 100.0, "ate_time_pct": 100.0, "ate_path": 5.0, "ate_spread": 2.0,
        "recall_1pct": 50.0, "rot_deg": 1.0, "path_length": 5.0, "fps": 10.0, "peak_rss_mb": 100.0,
    }  # fmt: skip
    return base | changed


def pretend(task: RunTask) -> Outcome:
    """Stands in for a run: its error is the seed's, and tasks whose name tells trouble have it. Counts its calls in the folder."""
    identity = task.identity()
    done = finished(task.folder, identity)
    if done is not None:
        return done
    if task.name.startswith("lt3"):
        raise RuntimeError("the worker was eaten")
    if task.name.startswith("lt2"):
        return Outcome(2, error="thegra: no\n camera")
    task.folder.mkdir(parents=True, exist_ok=True)
    seed = int(task.options[task.options.index("--seed") + 1])
    tracked = 30.0 if task.name.startswith("lt1") else 100.0
    figures = metrics(ate_rmse=round(0.1 * (seed + 1), 3), tracked_pct=tracked)
    with (task.folder / "calls.log").open("a") as log:
        log.write("called\n")
    (task.folder / "metrics.json").write_text(json.dumps(figures))
    (task.folder / IDENTITY).write_text(json.dumps(identity | {"exit_code": 0}))
    return Outcome(0, figures)
