"""A ROS graph for tests: nodes as processes, and a node of the test that sends images and keeps what comes back.

Every wait is for a condition, with a limit far beyond what it takes.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from thegra_core.evaluation.benchmark.memory import descendants
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame
from thegra_ros.camera_input import described
from thegra_ros.codec.images import camera_info_message, image_message
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.qos import LATCHED, LOSSLESS, RELIABLE

NodeT = TypeVar("NodeT", bound=ManagedNode)
LIMIT_S = float(os.environ.get("THEGRA_TEST_LIMIT_S", "120"))
ASK_AGAIN_S = 15.0
NAMESPACE = "/thegra"
FAST = {"profile": "fast", "extractor.name": "orb", "preprocessing.filters": "he_clip", "loop.enabled": "false"}
"""Parameters with which no network is needed, and a frame takes a tenth of a second."""
OFFLINE = {name: "[{filter: he_clip}]" if name == "preprocessing.filters" else value for name, value in FAST.items() if name != "profile"}
"""The same as overrides of a configuration."""
EVERY_IMAGE = {f"qos_overrides.{NAMESPACE}/image_raw.subscription.reliability": "reliable", f"qos_overrides.{NAMESPACE}/image_raw.subscription.depth": "1000", "queue_size": "1000"}
"""With these a node receives and works on all that a test sends."""
OFTEN = {"diagnostics_period_s": "0.1"}
"""Tests pace their images by what the nodes say that they have worked on."""
IN_STEP = {"engine": "thread"}
"""Mapping in step with tracking: the poses are those of the offline run, however fast the images come."""


class NodeProcess:
    """A node as a process of its own; its output is kept."""

    def __init__(self, module: str, parameters: dict[str, str], environment: dict[str, str], log: Path, extra: Sequence[str] = ()) -> None:
        arguments = ["--ros-args", "-r", f"__ns:={NAMESPACE}", *extra]
        for name, value in parameters.items():
            arguments += ["-p", f"{name}:={value}"]
        self._log = log
        self._file = log.open("w")
        self.process = subprocess.Popen([sys.executable, "-m", module, *arguments], env=environment, stdout=self._file, stderr=subprocess.STDOUT)

    @property
    def output(self) -> str:
        self._file.flush()
        return self._log.read_text()

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal; the exit code."""
        self.process.send_signal(number)
        return self.process.wait(LIMIT_S)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._file.close()


class Graph:
    """The test's own node, and the processes it started."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.environment = {
            **os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": str(folder), "OMP_NUM_THREADS": "1",
        }  # fmt: skip
        self._folder = folder
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("test", context=self._context, namespace=NAMESPACE)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._processes: list[NodeProcess] = []
        self._nodes: list[ManagedNode] = []
        self._images = self.node.create_publisher(Image, "image_raw", LOSSLESS)
        self._infos = self.node.create_publisher(CameraInfo, "camera_info", RELIABLE)
        self.received: dict[str, list[Any]] = {}
        for kind, topic, qos in (
            (PoseWithCovarianceStamped, "pose", LOSSLESS), (Odometry, "odometry", LOSSLESS), (PathMessage, "path", LATCHED), (PathMessage, "keyframe_path", LATCHED),
            (PointCloud2, "map_points", LATCHED), (DiagnosticArray, "/diagnostics", LOSSLESS),
        ):  # fmt: skip
            self.listen(kind, topic, qos)

    # ---- what the test does -----------------------------------------------------------------------------------------------------

    def start(self, module: str = "thegra_ros.nodes.slam", parameters: dict[str, str] | None = None, extra: Sequence[str] = ()) -> NodeProcess:
        log = self._folder / f"{module.rsplit('.', 1)[-1]}_{len(self._processes)}.log"
        process = NodeProcess(module, {**FAST, **EVERY_IMAGE, **OFTEN, **IN_STEP, **(parameters or {})}, self.environment, log, extra)
        self._processes.append(process)
        return process

    def add(self, make: Callable[..., NodeT]) -> NodeT:
        """A node in the test's own process, worked on while the test waits."""
        made = make(context=self._context, namespace=NAMESPACE)
        self._executor.add_node(made)
        self._nodes.append(made)
        return made

    def forget(self, process: NodeProcess) -> None:
        """It was killed by the test."""
        process.close()
        self._processes.remove(process)

    def listen(self, kind: type, topic: str, qos: Any) -> list[Any]:
        kept = self.received.setdefault(topic, [])
        self.node.create_subscription(kind, topic, kept.append, qos)
        return kept

    def wait(self, condition: Callable[[], bool], what: str = "") -> None:
        end = time.monotonic() + LIMIT_S
        while not condition():
            for process in self._processes:
                if process.process.poll() not in (None, 0):
                    raise AssertionError(f"a node ended with {process.process.returncode}:\n{process.output}")
            if time.monotonic() > end:
                raise AssertionError(f"waited in vain for {what or condition}:\n" + "\n".join(p.output for p in self._processes))
            self._executor.spin_once(timeout_sec=0.1)

    def spin_for(self, seconds: float) -> None:
        """Take messages for a while, between two attempts."""
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=rest)

    def wait_for_listener(self) -> None:
        self.wait(lambda: self._images.get_subscription_count() > 0 and bool(self.received["/diagnostics"]), "a node that listens to images")

    def spin_until(self, condition: Callable[[], bool], seconds: float) -> None:
        """Take messages until something is so, or for so long: one of several attempts."""
        end = time.monotonic() + seconds
        while not condition() and (rest := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(rest, 0.1))

    def send_camera(self, camera: CameraModel, *nodes: str, until: Callable[[], bool] | None = None) -> None:
        """Publish a camera's calibration over and over, as drivers do, until the nodes (`slam` if none is named) say that they have it, or `until` is so.

        One message may be lost: nodes listen with best effort.
        """
        message = camera_info_message(header(0, "thermal_camera"), camera)
        taken = until or (lambda: all(self.said(node, "camera") == described(camera) for node in nodes or ("slam",)))
        end = time.monotonic() + LIMIT_S
        while True:
            self._infos.publish(message)
            self.spin_until(taken, 0.5)
            if taken():
                return
            assert time.monotonic() < end, "waited in vain for nodes that take the camera\n" + "\n".join(p.output for p in self._processes)

    def send(self, frames: Sequence[Frame], encoding: str | None = None) -> None:
        for frame in frames:
            message = image_message(header(frame.stamp_ns, "thermal_camera"), frame.image)
            message.encoding = encoding or message.encoding
            self._images.publish(message)

    def wait_for_pose(self, frame: Frame) -> None:
        """Wait for the pose of a frame that is tracked: topics overtake each other, and /diagnostics may tell of it sooner."""
        self.wait(lambda: any(stamp_ns(m) == frame.stamp_ns for m in self.received["pose"]), f"the pose of frame {frame.index}")

    def call(self, kind: type, name: str, request: Any) -> Any:
        """Ask a service, and again where no answer has come for a while.

        A server that has not yet discovered where this client takes answers drops its answer after 0.1 s (ros2/rmw_fastrtps, issue 842).
        """
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, f"service {name}")
        asked: list[Any] = []
        end = time.monotonic() + LIMIT_S
        while not any(future.done() for future in asked) and time.monotonic() < end:
            asked.append(client.call_async(request))
            self.spin_until(lambda: any(future.done() for future in asked), ASK_AGAIN_S)
        self.wait(lambda: any(future.done() for future in asked), f"an answer of {name}")
        return next(future.result() for future in asked if future.done())

    def change_state(self, transition: int, name: str = "slam") -> bool:
        request = ChangeState.Request()
        request.transition.id = transition
        return bool(self.call(ChangeState, f"{name}/change_state", request).success)

    def state(self, name: str = "slam") -> str:
        return str(self.call(GetState, f"{name}/get_state", GetState.Request()).current_state.label)

    # ---- what the test reads ----------------------------------------------------------------------------------------------------

    @property
    def status(self) -> DiagnosticStatus | None:
        heard = self.received["/diagnostics"]
        return heard[-1].status[0] if heard else None

    def heard(self, level: bytes, text: str) -> bool:
        """Whether /diagnostics has said that, at any time."""
        return any(s.level == level and text in s.message for message in self.received["/diagnostics"] for s in message.status)

    def value(self, key: str) -> str:
        status = self.status
        return _value(status, key) if status is not None else ""

    def said(self, node: str, key: str) -> str:
        """What a node last said of something, or nothing."""
        return next((_value(s, key) for m in reversed(self.received["/diagnostics"]) for s in m.status if s.name.endswith(node)), "")

    def processed(self) -> int:
        return int(self.value("processed") or 0)

    def close(self) -> None:
        for process in self._processes:
            process.close()
        for node in self._nodes:
            node.end()
            self._executor.remove_node(node)
            node.destroy_node()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.shutdown()


def children(pid: int) -> list[int]:
    """Processes that a node has started for the system, or for its map."""
    return [child for child in descendants(pid) if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()]


def _value(status: DiagnosticStatus, key: str) -> str:
    return next((v.value for v in status.values if v.key == key), "")


def set_parameter(name: str, value: Any) -> Any:
    return Parameter(name, value=value).to_parameter_msg()
