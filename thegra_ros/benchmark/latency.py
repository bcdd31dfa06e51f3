"""How much later a pose comes when its image goes through ROS: nodes against the same system called directly, on the same frames at the same rate."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from thegra_core.cli.run import make_live_system
from thegra_core.config import ThegraConfig
from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, TrackingState
from thegra_ros.benchmark.processes import NAMESPACE, running
from thegra_ros.codec.images import camera_info_message, image_message
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.qos import LATCHED, RELIABLE

GRAPHS = {"one process": ("slam",), "four processes": ("preprocessing", "frontend", "tracking", "mapping")}
TARGETS_MS = {"one process": 5.0, "four processes": 12.0}
BETWEEN_STAGES = ("image_preprocessed", "shutter", "features", "matches", "wanted", "reference", "keyframe", "map_update")
DISCOVERY_LIMIT_S, SETTLE_S, LAST_POSE_S = 60.0, 2.0, 5.0


@dataclass(frozen=True, slots=True)
class Overhead:
    """Milliseconds from image to pose by way of ROS, directly, and their difference frame by frame; over frames that did not wait for the one before.

    Keyframes take twice as long, and the same frames need not become keyframes again: those that are by both ways are told apart, those by one are left out.
    """

    graph: str
    frames: int
    direct_ms: float
    ros_ms: float
    overhead_ms: float
    overhead_p95_ms: float
    keyframes: int
    keyframe_overhead_ms: float | None
    target_ms: float


def benchmark(frames: Sequence[Frame], camera: CameraModel, config: ThegraConfig, rate_hz: float, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure both graphs.

    Raises:
        InputError: If no frame is tracked, or none by one of the graphs.
    """
    say("the system, called directly")
    alone = direct(frames, camera, config, rate_hz)
    if not alone:
        raise InputError("no frame was tracked: take another recording, or more of it")
    found = []
    for graph, nodes in GRAPHS.items():
        say(graph)
        found.append(compare(graph, alone, *camera_to_pose(frames, camera, config, nodes, rate_hz)))
    width, height = camera.image_size
    return {"image_size": [width, height], "frames": len(frames), "rate_hz": rate_hz, "extractor": config.extractor.name, "graphs": [asdict(item) for item in found]}


@dataclass(frozen=True, slots=True)
class Alone:
    """A frame by the system called directly."""

    ms: float
    is_keyframe: bool


def compare(graph: str, alone: dict[int, Alone], by_ros: dict[int, float], keyframes_by_ros: Set[int]) -> Overhead:
    """Both times of the frames that have both.

    Raises:
        InputError: If there is none but keyframes.
    """
    both = sorted(set(alone) & set(by_ros))
    plain = [stamp for stamp in both if not alone[stamp].is_keyframe and stamp not in keyframes_by_ros]
    if not plain:
        raise InputError(f"{graph}: no frame but keyframes has a pose that did not wait for the frame before; a lower --rate helps")
    shared = [stamp for stamp in both if alone[stamp].is_keyframe and stamp in keyframes_by_ros]
    of_plain, of_keyframes = ([by_ros[stamp] - alone[stamp].ms for stamp in stamps] for stamps in (plain, shared))
    return Overhead(
        graph, len(plain), _median([alone[s].ms for s in plain]), _median([by_ros[s] for s in plain]), _median(of_plain),
        round(float(np.percentile(of_plain, 95)), 2), len(of_keyframes), _median(of_keyframes) if of_keyframes else None, TARGETS_MS[graph],
    )  # fmt: skip


def _median(values: Sequence[float]) -> float:
    return round(float(np.median(values)), 2)


def direct(frames: Sequence[Frame], camera: CameraModel, config: ThegraConfig, rate_hz: float) -> dict[int, Alone]:
    """Each tracked frame by its stamp, with mapping in a process of its own, as in `thegra run --realtime`."""
    taken: dict[int, Alone] = {}
    with closing(make_live_system(camera, config)) as slam:
        slam.warm_up()
        for frame in paced(frames, rate_hz):
            begin = time.monotonic()
            result = slam.process(frame)
            if result.state is TrackingState.TRACKING:
                taken[frame.stamp_ns] = Alone(1e3 * (time.monotonic() - begin), result.is_keyframe)
    return taken


def camera_to_pose(frames: Sequence[Frame], camera: CameraModel, config: ThegraConfig, nodes: Sequence[str], rate_hz: float) -> tuple[dict[int, float], Set[int]]:
    """Milliseconds from an image in the camera's process to its pose there, by stamp, of frames that did not find the one before still in work; and the stamps of keyframes."""
    sent: dict[int, float] = {}
    with running(nodes, config), _camera() as driver:
        driver.wait_for(BETWEEN_STAGES if len(nodes) > 1 else ())
        for frame in paced(frames, rate_hz):
            stamped = header(frame.stamp_ns, "thermal_camera")
            driver.infos.publish(camera_info_message(stamped, camera))
            sent[frame.stamp_ns] = time.monotonic()
            driver.images.publish(image_message(stamped, frame.image))
        end = time.monotonic() + LAST_POSE_S
        while frames[-1].stamp_ns not in driver.received and time.monotonic() < end:
            time.sleep(0.1)
        received, keyframes = dict(driver.received), frozenset(driver.keyframes)
    return unhindered(sent, received), keyframes


def unhindered(sent: dict[int, float], received: dict[int, float]) -> dict[int, float]:
    """Milliseconds by stamp of the frames whose predecessor had its pose before they were sent."""
    taken: dict[int, float] = {}
    before: int | None = None
    for stamp, begin in sent.items():
        if stamp in received and (before is None or received.get(before, np.inf) < begin):
            taken[stamp] = 1e3 * (received[stamp] - begin)
        before = stamp
    return taken


def paced(frames: Sequence[Frame], rate_hz: float) -> Iterator[Frame]:
    """The frames, each when its time has come."""
    due = time.monotonic()
    for frame in frames:
        time.sleep(max(0.0, due - time.monotonic()))
        yield frame
        due = max(due + 1.0 / rate_hz, time.monotonic())


class _Driver(Node):
    """A camera that also listens to the poses."""

    def __init__(self) -> None:
        super().__init__("camera", namespace=NAMESPACE)
        self.images = self.create_publisher(Image, "image_raw", RELIABLE)
        self.infos = self.create_publisher(CameraInfo, "camera_info", RELIABLE)
        self.received: dict[int, float] = {}
        self.keyframes: set[int] = set()
        self.create_subscription(PoseWithCovarianceStamped, "pose", self._on_pose, RELIABLE)
        self.create_subscription(Path, "keyframe_path", self._on_keyframes, LATCHED)

    def wait_for(self, topics: Sequence[str]) -> None:
        """Wait until images are listened to, poses are published, and the stages have found each other.

        Raises:
            InputError: If that does not happen.
        """
        end = time.monotonic() + DISCOVERY_LIMIT_S
        while not (self.images.get_subscription_count() and self.count_publishers("pose") and all(self.count_publishers(t) and self.count_subscribers(t) for t in topics)):
            if time.monotonic() > end:
                raise InputError("the nodes do not find each other: see what they say above")
            time.sleep(0.1)
        time.sleep(SETTLE_S)  # they hear of each other a little later than this node hears of them

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.received[stamp_ns(message)] = time.monotonic()

    def _on_keyframes(self, message: Path) -> None:
        self.keyframes.update(stamp_ns(pose) for pose in message.poses)


@contextmanager
def _camera() -> Any:
    rclpy.init(args=[])
    try:
        driver, executor = _Driver(), SingleThreadedExecutor()
        executor.add_node(driver)
        thread = threading.Thread(target=_spin, args=(executor,), daemon=True)
        thread.start()
        yield driver
    finally:
        rclpy.try_shutdown()
        thread.join()


def _spin(executor: SingleThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return
