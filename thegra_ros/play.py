"""`thegra play`: a recording onto image_raw and camera_info."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image

from thegra_core.errors import ConfigError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame
from thegra_core.sources.open import camera_for, open_recording
from thegra_core.sources.recording import Recording
from thegra_ros.codec.images import camera_info_message, image_message
from thegra_ros.codec.stamps import header, time_message
from thegra_ros.environment import use_large_segments
from thegra_ros.qos import RELIABLE, publisher_options

CLOCK_PERIOD_S = 0.02
FLUSH_S = 2.0
"""At the end listeners have so long to confirm the last images."""


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """The command's options; None: not given."""

    recording: Path
    topic: str | None = None
    camera: str | None = None
    rate: float = 1.0
    loop: bool = False
    clock: bool = False
    wait_s: float = 5.0
    max_frames: int | None = None
    namespace: str = "thegra"
    extra: tuple[str, ...] = ()


def play(options: PlayOptions) -> int:
    """Play until the end or until told to end; the exit code.

    Raises:
        ThegraError: If the recording or an argument cannot be used.
    """
    if options.extra and options.extra[0] != "--ros-args":
        raise ConfigError(f"{options.extra[0]} is not understood: see thegra play --help; what is for ROS goes behind --ros-args")
    recording = open_recording(options.recording, options.topic)
    camera = camera_for(recording, options.camera) if options.camera is not None else recording.camera
    use_large_segments()
    rclpy.init(args=[*(options.extra or ("--ros-args",)), "-r", f"__ns:=/{options.namespace.strip('/')}"])
    try:
        player = Player(camera, options)
        player.wait_for_listeners(options.wait_s)
        player.play(recording)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except Exception:
        if rclpy.ok():
            raise
        return 0  # told to end while an image was being sent
    finally:
        rclpy.try_shutdown()
    return 0


class Player(Node):
    """Publishes frames as a camera driver would."""

    def __init__(self, camera: CameraModel | None, options: PlayOptions) -> None:
        super().__init__("play")
        self._options, self._camera = options, camera
        self._frame_id = (camera.name if camera is not None else "") or "thermal_camera"
        self._images = self.create_publisher(Image, "image_raw", RELIABLE, **publisher_options(self, "image_raw"))
        self._infos = self.create_publisher(CameraInfo, "camera_info", RELIABLE, **publisher_options(self, "camera_info")) if camera is not None else None
        self._clock = self.create_publisher(Clock, "/clock", RELIABLE) if options.clock else None
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        if camera is None:
            self.get_logger().warning("the recording has no calibration: no camera_info is published; give one with --camera FILE")

    def wait_for_listeners(self, limit_s: float) -> None:
        """Wait until someone listens to the images."""
        self._spin_until(time.monotonic() + limit_s, lambda: self._images.get_subscription_count() > 0)
        if self._images.get_subscription_count() == 0:
            self.get_logger().warning(f"nobody listens to {self._images.topic_name}")

    def play(self, recording: Recording) -> None:
        """Publish every frame when its time has come."""
        count = 0
        for turn in itertools.count():
            count += self._once(recording)
            if not self._options.loop:
                break
            self.get_logger().info(f"turn {turn + 2} begins")
        for publisher in filter(None, (self._images, self._infos, self._clock)):
            publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=FLUSH_S))
        self.get_logger().info(f"{count} images played" + "".join(f"; {n} x {reason}" for reason, n in recording.problems.items()))

    def _once(self, recording: Recording) -> int:
        due_s, before, count = time.monotonic(), None, 0
        for frame in self._limited(recording.frames()):
            due_s += max(0, frame.stamp_ns - before) / 1e9 / self._options.rate if before is not None else 0.0
            self._pass_time(due_s, before if before is not None else frame.stamp_ns)
            self._publish(frame)
            before, count = frame.stamp_ns, count + 1
        return count

    def _publish(self, frame: Frame) -> None:
        stamped = header(frame.stamp_ns, self._frame_id)
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamped.stamp))
        if self._infos is not None and self._camera is not None:
            self._infos.publish(camera_info_message(stamped, self._camera))
        self._images.publish(image_message(stamped, frame.image))

    def _pass_time(self, due_s: float, stamp_ns: int) -> None:
        """Wait for a frame's time, while /clock goes on from the frame before."""
        begin = time.monotonic()
        while (now := time.monotonic()) < due_s:
            self._spin_until(min(due_s, now + CLOCK_PERIOD_S) if self._clock is not None else due_s, lambda: False)
            if self._clock is not None and time.monotonic() < due_s:
                self._clock.publish(Clock(clock=time_message(stamp_ns + round((time.monotonic() - begin) * self._options.rate * 1e9))))

    def _spin_until(self, end_s: float, condition: Callable[[], bool]) -> None:
        while not condition() and (rest := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(rest, 0.1))
            if not rclpy.ok():
                raise ExternalShutdownException

    def _limited(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        return itertools.islice(frames, self._options.max_frames)
