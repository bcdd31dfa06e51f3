"""Features and matches in; poses out, keyframes to mapping, and the map's updates back.

After a keyframe tracking waits for mapping's update: the same steps as in one thread, whatever the network does.
"""

from __future__ import annotations

import queue
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from thegra_core.features.registry import make_matcher
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Shutter, TrackingResult, TrackingState
from thegra_core.tracking.stage import TrackingOutput, TrackingStage
from thegra_ros.camera_input import CameraInput
from thegra_ros.camera_place import CameraPlace
from thegra_ros.codec.clouds import Table, cloud_table
from thegra_ros.codec.poses import odometry
from thegra_ros.codec.records import Assembler, initial_map_tables, keyframe_tables, record_clouds, table_features, table_matches, tables_update
from thegra_ros.codec.shutter import FrameNotice, read_notice
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.joiner import FrameJoiner
from thegra_ros.lifecycle import run_node
from thegra_ros.outputs import PoseOutputs
from thegra_ros.qos import LATCHED, LOSSLESS
from thegra_ros.stage_node import EVERYTHING, StageNode
from thegra_ros.transforms import stamped_pose

PATIENCE_S = 5.0
"""After so long a wait for mapping it is said that it does not answer."""


class TrackingNode(StageNode):
    """The third stage."""

    queue_size = EVERYTHING

    def __init__(self) -> None:
        super().__init__("tracking")

    def prepare(self) -> None:
        self._place = CameraPlace(self, self.own)
        self._poses = PoseOutputs(self, self._place.frames, self.own)
        self._keyframes = self.publisher(PointCloud2, "keyframe", LOSSLESS)
        self._keyframe_poses = self.publisher(Odometry, "keyframe_pose", LOSSLESS)
        self._references = self.publisher(Header, "reference", LATCHED)
        self._stage: TrackingStage | None = None
        self._epoch, self._reference_ns, self._fresh = -1, 0, True
        self._assembler, self._updates = Assembler(), queue.SimpleQueue[tuple[str, list[Table]]]()
        self._camera = CameraInput(self, self.own.camera_file, self.health, self._want_anew)
        self._joiner = FrameJoiner("notice", lambda parts: {"features", "matches"} <= set(parts) or _closed(parts), _closed)
        self.listen(DiagnosticArray, "shutter", LOSSLESS, lambda m: self._join("notice", stamp_ns(m), read_notice(m)))
        self.listen(PointCloud2, "features", LOSSLESS, lambda m: self._join("features", stamp_ns(m), table_features(cloud_table(m))))
        self.listen(PointCloud2, "matches", LOSSLESS, lambda m: self._join("matches", stamp_ns(m), table_matches(cloud_table(m))))
        self.listen(PointCloud2, "map_update", LOSSLESS, self._on_update)
        self.serve(Trigger, "~/reset", self._on_reset)

    def load(self) -> None:
        self._matcher = make_matcher(self.config.matcher, self.config.extractor)

    def work(self, item: Mapping[str, Any]) -> None:
        notice: FrameNotice = item["notice"]
        camera = self._camera.camera
        if camera is None:
            self.health.bad["image without a camera"] += 1
            return
        self._place.see(notice.frame_id)
        if self._stage is None or self._fresh or notice.epoch != self._epoch:
            self._begin_stage(camera, notice.epoch)
        output = self._track(item, notice, camera)
        self._tell_mapping(output, notice)
        self._tell_frontend()
        self._poses.publish(output.result, self._place.frames)
        if self.health.result_came(output.result):
            self.reporter.report()

    def begin_anew(self, why: str) -> None:
        self._fresh = True

    def facts(self) -> dict[str, object]:
        stage = self._stage
        return {"state": self.health.state.value, "lost parts": self._joiner.lost + self._assembler.broken, "map": stage.map_id if stage is not None else -1}

    # ---- the working thread ---------------------------------------------------------------------------------------------------------

    def _begin_stage(self, camera: CameraModel, epoch: int) -> None:
        if self._stage is not None:
            self.get_logger().info("a new map begins")
        self._stage, self._epoch, self._fresh = TrackingStage(camera, self.config, self._matcher), epoch, False
        self._poses.forget()
        self._send("reset", [_word({})], 0)
        while not self._updates.empty():
            self._updates.get()

    def _track(self, item: Mapping[str, Any], notice: FrameNotice, camera: CameraModel) -> TrackingOutput:
        assert self._stage is not None
        state = notice.shutter
        if state.shutter is Shutter.CLOSED:
            return self._stage.hold(state.stamp_ns, state.reason)
        if item["features"].image_size != camera.image_size:
            return TrackingOutput(TrackingResult(state.stamp_ns, TrackingState.LOST, reason="image size differs from the camera's"))
        if state.shutter is Shutter.JUST_OPENED:
            self._stage.reopen()
        matches = item["matches"] if item["matches"].reference_stamp_ns else None
        return self._stage.process(item["features"], matches)

    def _tell_mapping(self, output: TrackingOutput, notice: FrameNotice) -> None:
        stamp = output.result.stamp_ns
        if output.dropped_map_id is not None:
            self._send("drop", [_word({"map": str(output.dropped_map_id)})], stamp)
        if output.initial_map is not None:
            self._send("initial_map", initial_map_tables(output.initial_map), stamp)
            self._wait_for_update()
        elif output.keyframe is not None:
            pose = stamped_pose(stamp, output.keyframe.world_from_camera, output.result.covariance, output.result.twist, self._place.frames)
            self._keyframe_poses.publish(odometry(header(stamp, self._place.frames.map), self._place.frames.child, pose))
            self._send("keyframe", keyframe_tables(output.keyframe), stamp)
            self._wait_for_update()

    def _wait_for_update(self) -> None:
        while not self.stopping.is_set() and not self._fresh:
            try:
                kind, tables = self._updates.get(timeout=PATIENCE_S)
            except queue.Empty:
                self.get_logger().warning("waiting for the node mapping, which does not answer")
                continue
            if kind == "unknown":
                self._want_anew("mapping does not know the map: it was started again")
            elif self._stage is not None:
                self._stage.apply(tables_update(tables))
            return

    def _tell_frontend(self) -> None:
        reference = self._stage.reference_features if self._stage is not None else None
        if reference is not None and reference.stamp_ns != self._reference_ns:
            self._reference_ns = reference.stamp_ns
            self._references.publish(header(reference.stamp_ns, self._place.frames.camera))

    def _send(self, kind: str, tables: list[Table], stamp: int) -> None:
        for cloud in record_clouds(header(stamp, self._place.frames.camera), kind, tables):
            self._keyframes.publish(cloud)

    # ---- callbacks ------------------------------------------------------------------------------------------------------------------

    def _join(self, part: str, stamp: int, value: Any) -> None:
        if not self.active:
            return
        if part == "notice":
            self.health.image_came()
        for frame in self._joiner.add(part, stamp, value):
            self.enqueue(frame)

    def _on_update(self, cloud: PointCloud2) -> None:
        record = self._assembler.add(cloud)
        if record is not None:
            self._updates.put(record)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._want_anew("reset was called")
        response.success, response.message = True, "a new map begins with the next image"
        return response

    def _want_anew(self, why: str) -> None:
        self._fresh = True
        self.health.state = TrackingState.INITIALIZING
        self.get_logger().info(f"what is known is forgotten: {why}")


def _closed(parts: Mapping[str, Any]) -> bool:
    return "notice" in parts and parts["notice"].shutter.shutter is Shutter.CLOSED


def _word(facts: dict[str, str]) -> Table:
    return Table({"id": np.empty(0, np.int64)}, facts)


def main() -> None:
    """The executable `tracking`."""
    sys.exit(run_node(TrackingNode))


if __name__ == "__main__":
    main()
