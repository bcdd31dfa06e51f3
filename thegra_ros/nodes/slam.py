"""The whole system as one node: images in, pose, path and map out.

Callbacks convert and enqueue; a thread hands frames to the engine, which works in a process of its own, and publishes what comes back.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from std_srvs.srv import SetBool, Trigger

from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, TrackingState
from thegra_core.process import keep_freed_memory
from thegra_ros.answers import result_of
from thegra_ros.camera_input import CameraInput
from thegra_ros.camera_place import CameraPlace
from thegra_ros.diagnostics import Health, Reporter
from thegra_ros.engine import BeginIn, Done, Engine, Job, LocalEngine, Order, ProcessEngine, SaveMap
from thegra_ros.image_input import ImageInput
from thegra_ros.lifecycle import ManagedNode, run_node
from thegra_ros.node_parameters import NodeParameters, begin_in
from thegra_ros.outputs import MapOutputs, PoseOutputs, TracksOutput
from thegra_ros.worker import NotWorkingError, Worker


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
        self._images: ImageInput | None = None
        self.offer(Trigger, "~/reset", self._on_reset)
        self.offer(SetBool, "~/pause", self._on_pause)
        self.offer(Trigger, "~/save_map", self._on_save_map)
        self.offer(Trigger, "~/load_map", self._on_load_map)
        self.offer(SetBool, "~/localization_only", self._on_localization_only)

    # ---- transitions ----------------------------------------------------------------------------------------------------------------

    def configure(self) -> None:
        self._config, self._own = self._settings.read()
        self._home, self._localizing = begin_in(self._own), self._own.localization_only
        self._place, self._epoch = CameraPlace(self, self._own), 0
        self._map_sent_ns, self._map_id, self._ms, self._age_ms = 0, -1, 0.0, 0.0
        self._health = Health(TrackingState.WAITING)
        self._reporter = Reporter(self, self._health, self._facts, self._own.diagnostics_period_s)
        self._camera = CameraInput(self, self._own.camera_file, self._health, self._begin_anew)
        self._poses, self._map, self._tracks = PoseOutputs(self, self._place.frames, self._own), MapOutputs(self), TracksOutput(self)
        self._images = ImageInput(self, self._own.image_transport, self._health, self._on_frame, self._on_restart)
        self._worker = Worker(self._new_engine, self._own.queue_size, self._to_job, self._on_done, self._on_failure, self._on_refused, self.context.ok)
        self._worker.start()
        self._settings.configured = True
        begins = f"; the camera is sought in the map of {self._home}" if self._home is not None else ""
        self.get_logger().info(f"profile {self._config.profile}; images from {self._images.topic}{begins}")

    def deactivate(self) -> None:
        if self._worker is not None:
            self._worker.queue.clear()

    def release(self) -> None:
        if self._images is not None:
            self._images.close()
        if self._worker is not None:
            self._worker.stop()
        self._worker = self._images = None
        self._settings.configured = False

    # ---- callbacks: convert, enqueue, return ----------------------------------------------------------------------------------------

    def _on_frame(self, frame: Frame, frame_id: str) -> None:
        camera = self._camera.camera
        if camera is None:
            self._health.bad["image without a camera"] += 1
            return
        self._place.see(frame_id)
        if self._worker is not None:
            self._worker.queue.put(Waiting(frame, camera, self._epoch))

    def _on_restart(self, why: str) -> None:
        """Time went back. A map that stays as it is holds for the new time, too."""
        if not self._localizing:
            self._begin_anew(why)
            return
        self._poses.forget()
        self.get_logger().info(f"the camera is sought in the map again: {why}")

    def _begin_anew(self, why: str) -> None:
        """Forget map and path; what is in work is for the old map and is thrown away when it comes."""
        self._epoch += 1
        if self._images is not None:
            self._images.forget()
        if self._worker is not None:
            self._worker.queue.clear()
        self._forget()
        self.get_logger().info(f"a new map begins: {why}" if self._home is None else f"the camera is sought in the map of {self._home}: {why}")

    def _forget(self) -> None:
        self._poses.forget()
        self._map.forget()
        self._health.state, self._health.reason = TrackingState.INITIALIZING, ""
        if not self._given_up:
            self._health.trouble = ""
        self._map_sent_ns, self._map_id = 0, -1

    # ---- services -------------------------------------------------------------------------------------------------------------------

    def _on_reset(self, _: Trigger.Request) -> str:
        if self._given_up:
            raise NotWorkingError
        if self._localizing and self._home is None:
            raise InputError("only localisation is on, and after a reset there would be no map: call ~/localization_only with false first")
        if not self._localizing:
            self._home = None
        self._begin_anew("reset was called")
        return "a new map begins with the next image" if self._home is None else f"the camera is sought in the map of {self._home}"

    def _on_pause(self, request: SetBool.Request) -> str:
        self._health.paused = bool(request.data)
        self._reporter.report()
        return "paused: images are ignored" if request.data else "images are worked on"

    async def _on_save_map(self, _: Trigger.Request) -> str:
        return await self._ask(SaveMap(self._settings.map_file))

    async def _on_load_map(self, _: Trigger.Request) -> str:
        path, camera = self._settings.map_file, self._camera.camera
        if camera is None:
            raise InputError(f"a map belongs to a camera, and there is none yet: {self._health.camera_trouble}")
        self._epoch += 1

        def loaded() -> None:
            self._home = path
            self._forget()

        return await self._ask(BeginIn(path, camera, self._epoch), loaded)

    def _on_localization_only(self, request: SetBool.Request) -> str:
        if request.data and self._home is None and self._map_id < 0:
            raise InputError("there is no map yet in which the camera could be found: wait for one, or call ~/load_map")
        self._localizing = bool(request.data)
        return "the map stays as it is" if request.data else "the map grows"

    @property
    def _given_up(self) -> bool:
        return self._worker is not None and self._worker.given_up

    async def _ask(self, order: Order, then: Callable[[], None] = lambda: None) -> str:
        assert self._worker is not None
        return await result_of(self, self._worker.ask(order, then))

    # ---- the working thread ---------------------------------------------------------------------------------------------------------

    def _new_engine(self) -> Engine:
        return ProcessEngine(self._config) if self._own.engine == "process" else LocalEngine(self._config)

    def _to_job(self, waiting: Waiting) -> Job | None:
        if waiting.epoch != self._epoch:
            return None
        wants_map = not 0 <= waiting.frame.stamp_ns - self._map_sent_ns < self._own.map_period_s * 1e9
        return Job(waiting.frame, waiting.camera, waiting.epoch, self._tracks.wanted, wants_map, self._home, self._localizing)

    def _on_done(self, waiting: Waiting, done: Done, ms: float) -> None:
        if not self.active or waiting.epoch != self._epoch:
            return
        result = done.result
        if result.map_id >= 0 and result.map_id != self._map_id:
            if self._map_id >= 0:
                news = f"a new map ({result.map_id}) was begun after tracking was lost" if result.map_id > self._map_id else f"the map has become part of map {result.map_id}"
                self.get_logger().warning(f"{news}: poses are in another frame of reference from now on")
            self._map_id = result.map_id
        self._poses.publish(result, self._place.frames)
        if done.map is not None and result.state is TrackingState.TRACKING:
            self._map_sent_ns = result.stamp_ns
            self._map.publish(result.stamp_ns, done.map, self._place.frames)
        if done.view is not None:
            self._tracks.publish(done.view, self._place.frames.camera)
        self._ms, self._age_ms = ms, (self.get_clock().now().nanoseconds - result.stamp_ns) / 1e6
        self._health.worked()
        if self._health.result_came(result):
            self._reporter.report()

    def _on_failure(self, text: str, final: bool) -> None:
        self.get_logger().error(text)
        self._localizing = self._localizing and self._home is not None  # the map that was to stay is gone
        self._begin_anew("the SLAM system failed")
        if final:
            self._health.trouble = text.splitlines()[-1]
        self._reporter.report()

    def _on_refused(self, waiting: Waiting, text: str) -> None:
        """What waits is of the same epoch and is passed over: another camera, ~/reset and ~/load_map are another try."""
        if waiting.epoch != self._epoch:
            return
        self.get_logger().error(text)
        self._health.trouble = text.splitlines()[-1]
        self._reporter.report()

    def _facts(self) -> Mapping[str, object]:
        dropped = self._worker.queue.dropped if self._worker is not None else 0
        return {
            "dropped": dropped, "state": self._health.state.value, "map": self._map_id, "map grows": "no" if self._localizing else "yes", "ms a frame": f"{self._ms:.0f}", "image to pose ms": f"{self._age_ms:.0f}",
            "camera": self._camera.described, "scale": f"{self._own.scale:g} m a map unit" if self._own.scale != 1.0 else "unknown",
        }  # fmt: skip


def main() -> None:
    """The executable `slam`."""
    keep_freed_memory()
    sys.exit(run_node(SlamNode))


if __name__ == "__main__":
    main()
