"""The whole system as one node: images in, pose, path and map out.

Callbacks convert and enqueue; a thread hands frames to the engine, which works in a process of its own, and publishes what comes back.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rclpy.clock import JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

from thegra_core.errors import ConfigError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, TrackingState
from thegra_core.process import keep_freed_memory
from thegra_core.sources.image_decoding import DecodeError
from thegra_ros.camera_input import CameraInput
from thegra_ros.codec.images import frame_from_image
from thegra_ros.diagnostics import Health, Reporter
from thegra_ros.engine import Done, Engine, Job, LocalEngine, ProcessEngine
from thegra_ros.lifecycle import ManagedNode, run_node
from thegra_ros.node_config import NodeConfig
from thegra_ros.node_parameters import NodeParameters
from thegra_ros.outputs import MapOutputs, PoseOutputs, TracksOutput
from thegra_ros.qos import SENSOR
from thegra_ros.stamp_watch import StampWatch
from thegra_ros.transforms import BODY_FROM_OPTICAL, Frames, extrinsics
from thegra_ros.worker import Worker


@dataclass(frozen=True, slots=True)
class Waiting:
    """A frame in the queue, with the camera and the map it was received for."""

    frame: Frame
    camera: CameraModel
    epoch: int


class SlamNode(ManagedNode):
    """docs/ros.md lists topics, services and parameters."""

    def __init__(self, **options: Any) -> None:
        super().__init__("slam", **options)
        self._settings = NodeParameters(self)
        self._worker: Worker[Waiting] | None = None
        self._jumps: JumpHandle | None = None

    # ---- transitions ----------------------------------------------------------------------------------------------------------------

    def configure(self) -> None:
        self._config, self._own = self._settings.read()
        self._frames = frames_of(self._own)
        self._stamps, self._epoch, self._index = StampWatch(), 0, 0
        self._map_sent_ns, self._map_id, self._ms, self._age_ms = 0, -1, 0.0, 0.0
        self._health = Health()
        self._reporter = Reporter(self, self._health, self._facts)
        self._camera = CameraInput(self, self._own.camera_file, self._health, self._begin_anew)
        self._poses, self._map, self._tracks = PoseOutputs(self, self._frames, self._own), MapOutputs(self), TracksOutput(self)
        raw = self._own.image_transport == "raw"
        self.listen(Image if raw else CompressedImage, "image_raw" if raw else "image_raw/compressed", SENSOR, self._on_image)
        self.serve(Trigger, "~/reset", self._on_reset)
        self.serve(SetBool, "~/pause", self._on_pause)
        backwards = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        self._jumps = self.get_clock().create_jump_callback(backwards, post_callback=self._on_jump)
        self._worker = Worker(self._new_engine, self._own.queue_size, self._to_job, self._on_done, self._on_failure, self.context.ok)
        self._worker.start()
        self._settings.configured = True
        self.get_logger().info(f"profile {self._config.profile}; images from {self.resolve_topic_name('image_raw')}")

    def deactivate(self) -> None:
        if self._worker is not None:
            self._worker.queue.clear()

    def release(self) -> None:
        if self._jumps is not None:
            self._jumps.unregister()
        if self._worker is not None:
            self._worker.stop()
        self._worker = self._jumps = None
        self._settings.configured = False

    # ---- callbacks: convert, enqueue, return ----------------------------------------------------------------------------------------

    def _on_image(self, message: Image | CompressedImage) -> None:
        if not self.active or self._worker is None:
            return
        self._health.image_came()
        if self._health.paused:
            return
        try:
            frame = frame_from_image(message, self._index)
        except DecodeError as error:
            self._health.bad[str(error)] += 1
            self.get_logger().warning(f"image not used: {error}", throttle_duration_sec=5.0)
            return
        self._index += 1
        if self._stamps.begins_anew(frame.stamp_ns):
            self._begin_anew("the images' stamps went back, as those of a bag that loops do")
        camera = self._camera.camera
        if camera is None:
            self._health.bad["image without a camera"] += 1
            return
        self._place_camera(message.header.frame_id)
        self._worker.queue.put(Waiting(frame, camera, self._epoch))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._begin_anew("reset was called")
        response.success, response.message = True, "a new map begins with the next image"
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._health.paused = bool(request.data)
        response.success, response.message = True, "paused: images are ignored" if request.data else "images are worked on"
        self.get_logger().info(response.message)
        self._reporter.report()
        return response

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.delta.nanoseconds < 0:
            self._begin_anew(f"time went back by {-jump.delta.nanoseconds / 1e9:.1f} s")

    def _begin_anew(self, why: str) -> None:
        """Forget map and path; what is in work is for the old map and is thrown away when it comes."""
        self._epoch += 1
        self._stamps.forget()
        if self._worker is not None:
            self._worker.queue.clear()
        self._poses.forget()
        self._health.state, self._health.reason = TrackingState.INITIALIZING, ""
        self._map_sent_ns = 0
        self.get_logger().info(f"a new map begins: {why}")

    def _place_camera(self, frame_id: str) -> None:
        """Name the camera's frame after the images, and find where it sits on the base."""
        camera = self._own.camera_frame or frame_id or "camera"
        if camera == self._frames.camera:
            return
        self._frames = replace(self._frames, camera=camera)
        if self._own.base_frame and not self._own.base_from_camera:
            found = self._poses.transforms.base_from_camera(camera)
            where = "from /tf_static" if found is not None else "nothing tells: taken to be at its origin, looking forward; give base_from_camera"
            self.get_logger().info(f"place of {camera} on {self._own.base_frame}: {where}")
            self._frames = replace(self._frames, base_from_camera=found if found is not None else BODY_FROM_OPTICAL)

    # ---- the working thread ---------------------------------------------------------------------------------------------------------

    def _new_engine(self) -> Engine:
        return ProcessEngine(self._config) if self._own.engine == "process" else LocalEngine(self._config)

    def _to_job(self, waiting: Waiting) -> Job:
        wants_map = not 0 <= waiting.frame.stamp_ns - self._map_sent_ns < self._own.map_period_s * 1e9
        return Job(waiting.frame, waiting.camera, waiting.epoch, self._tracks.wanted, wants_map)

    def _on_done(self, waiting: Waiting, done: Done, ms: float) -> None:
        if not self.active or waiting.epoch != self._epoch:
            return
        result = done.result
        if result.map_id >= 0 and result.map_id != self._map_id:
            if self._map_id >= 0:
                self.get_logger().warning(f"lost, and a new map ({result.map_id}) was begun: poses are in a new frame of reference")
            self._map_id = result.map_id
        self._poses.publish(result, self._frames)
        if done.map is not None and result.state is TrackingState.TRACKING:
            self._map_sent_ns = result.stamp_ns
            self._map.publish(result.stamp_ns, done.map, self._frames)
        if done.view is not None:
            self._tracks.publish(done.view, self._frames.camera)
        self._ms, self._age_ms = ms, (self.get_clock().now().nanoseconds - result.stamp_ns) / 1e6
        if self._health.result_came(result):
            self._reporter.report()

    def _on_failure(self, text: str, final: bool) -> None:
        self.get_logger().error(text)
        self._begin_anew("the SLAM system failed")
        if final:
            self._health.trouble = text.splitlines()[-1]
        self._reporter.report()

    def _facts(self) -> Mapping[str, object]:
        dropped = self._worker.queue.dropped if self._worker is not None else 0
        return {
            "dropped": dropped, "state": self._health.state.value, "map": self._map_id, "ms a frame": f"{self._ms:.0f}", "image to pose ms": f"{self._age_ms:.0f}",
            "camera": "known" if self._camera.camera is not None else "unknown", "scale": f"{self._own.scale:g} m a map unit" if self._own.scale != 1.0 else "unknown",
        }  # fmt: skip


def frames_of(own: NodeConfig) -> Frames:
    """Frame names and extrinsics that the parameters give; the camera's name comes with the first image.

    Raises:
        ConfigError: If base_from_camera is no pose, or odom_frame is given without base_frame.
    """
    if own.odom_frame and not own.base_frame:
        raise ConfigError(f"odom_frame {own.odom_frame} is given without base_frame, the frame that moves in it: give base_frame, as in base_frame:=base_link")
    try:
        placed = extrinsics(own.base_from_camera) if own.base_from_camera else BODY_FROM_OPTICAL
    except ValueError as error:
        raise ConfigError(f"base_from_camera: {error}") from error
    return Frames(own.map_frame, own.odom_frame, own.base_frame, own.camera_frame, np.asarray(placed), own.scale)


def main() -> None:
    """The executable `slam`."""
    keep_freed_memory()
    sys.exit(run_node(SlamNode))


if __name__ == "__main__":
    main()
