"""Features and matches in; poses out, keyframes to mapping, and the map's updates back.

After a keyframe tracking waits for mapping's update: the same steps as in one thread, whatever the network does. When it begins it asks mapping for the map,
so that it goes on where it was when its process was started again.
"""

from __future__ import annotations

import queue
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from enum import Enum
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from thegra_core.errors import InputError
from thegra_core.features.protocols import Wanted
from thegra_core.features.registry import make_matcher, make_tracking_matchers
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Matches, Shutter, TrackingResult, TrackingState
from thegra_core.tracking.stage import TrackingOutput, TrackingStage
from thegra_ros.camera_input import CameraInput
from thegra_ros.camera_place import CameraPlace
from thegra_ros.codec.clouds import Table, cloud_table
from thegra_ros.codec.poses import odometry
from thegra_ros.codec.records import Assembler, initial_map_tables, keyframe_tables, record_clouds, table_features, table_matches, tables_update, word
from thegra_ros.codec.rounds import SecondRound, is_followed, verdict_message
from thegra_ros.codec.shutter import FrameNotice, read_notice
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.joiner import FrameJoiner
from thegra_ros.lifecycle import run_node
from thegra_ros.outputs import PoseOutputs
from thegra_ros.qos import LATCHED, LOSSLESS
from thegra_ros.stage_node import StageNode
from thegra_ros.transforms import stamped_pose

PATIENCE_S = 5.0
"""After so long a wait for mapping it is said that it does not answer; a frame that frontend does not answer for is placed by what there is."""
WAKE_S = 0.2


class Beginning(Enum):
    """How tracking begins, as mapping is told."""

    RESUME = "resume"  # in the map that mapping has
    FRESH = "fresh"  # in that of its file, else in an empty one
    RESET = "reset"  # in an empty one


class TrackingNode(StageNode):
    """The third stage."""

    def __init__(self, **options: Any) -> None:
        super().__init__("tracking", **options)
        self.offer(Trigger, "~/reset", self._on_reset)
        self.offer(SetBool, "~/localization_only", self._on_localization_only)

    def prepare(self) -> None:
        self.health.state = TrackingState.WAITING
        self._place = CameraPlace(self, self.own)
        self._poses = PoseOutputs(self, self._place.frames, self.own)
        self._keyframes = self.publisher(PointCloud2, "keyframe", LOSSLESS)
        self._keyframe_poses = self.publisher(Odometry, "keyframe_pose", LOSSLESS)
        self._references = self.publisher(Header, "reference", LATCHED)
        self._stage: TrackingStage | None = None
        self._localizing = self.own.localization_only
        self._beginning: Beginning | None = Beginning.RESUME
        self._epoch, self._reference_ns, self._question = -1, 0, 0
        self._assembler, self._updates = Assembler(), queue.SimpleQueue[tuple[str, list[Table]]]()
        self._camera = CameraInput(self, self.own.camera_file, self.health, lambda why: self._want(Beginning.FRESH, why))
        self._joiner = FrameJoiner("notice", lambda parts: {"features", "matches"} <= set(parts) or _closed(parts), _closed)
        self.listen(DiagnosticArray, "shutter", LOSSLESS, lambda m: self._join("notice", stamp_ns(m), read_notice(m)))
        self._second, self._seconds = SecondRound(), queue.SimpleQueue[Mapping[str, Any]]()
        self._verdicts = self.publisher(Header, "wanted", LOSSLESS)
        self.listen(PointCloud2, "features", LOSSLESS, lambda m: self._on_part("features", cloud_table(m), table_features))
        self.listen(PointCloud2, "matches", LOSSLESS, lambda m: self._on_part("matches", cloud_table(m), table_matches))
        self.listen(PointCloud2, "map_update", LOSSLESS, self._on_update)

    def load(self) -> None:
        self._matcher, self._thorough = make_tracking_matchers(self.config, make_matcher(self.config.matcher, self.config.extractor))

    def work(self, item: Mapping[str, Any]) -> None:
        self._unanswered = "followed" in item
        try:
            self._work(item)
        finally:
            self._answer(item["notice"].shutter.stamp_ns, None)  # frontend waits for a word of every frame that it followed

    def _work(self, item: Mapping[str, Any]) -> None:
        notice: FrameNotice = item["notice"]
        camera = self._camera.camera
        if camera is None:
            self.health.bad["image without a camera"] += 1
            return
        self._place.see(notice.frame_id)
        if notice.epoch > self._epoch >= 0 and not self._localizing:  # a lower one: preprocessing was started again
            self._want(Beginning.FRESH, "the stream begins anew")
        self._epoch = notice.epoch
        stage = self._begun(camera, notice.shutter.stamp_ns)
        if stage is None:
            return
        stage.localization_only = self._localizing
        output = self._track(stage, item, camera)
        self._poses.publish(output.result, self._place.frames)  # mapping changes nothing of it: it need not wait
        self._tell_mapping(stage, output, notice)
        self._tell_frontend(stage)
        self._told(output.result)

    def pushed_out(self, item: Mapping[str, Any]) -> None:
        if "followed" in item:  # frontend waits for a word of this one, too
            self._verdicts.publish(verdict_message(item["notice"].shutter.stamp_ns, None))

    def begin_anew(self, why: str) -> None:
        self._beginning = Beginning.FRESH

    def facts(self) -> dict[str, object]:
        stage = self._stage
        return {
            "state": self.health.state.value, "lost parts": self._joiner.lost + self._assembler.broken, "map": stage.map_id if stage is not None else -1,
            "map grows": "no" if self._localizing else "yes", "camera": self._camera.described,
        }  # fmt: skip

    # ---- the working thread ---------------------------------------------------------------------------------------------------------

    def _begun(self, camera: CameraModel, stamp: int) -> TrackingStage | None:
        """The stage to go on with, begun if that is due; None while mapping cannot tell in what."""
        beginning = self._beginning
        if beginning is None:
            return self._stage
        self._beginning, self._stage = None, None
        self._poses.forget()
        self._question += 1
        question = {"question": str(self._question), "beginning": beginning.value}
        answer = self._ask_mapping("begin", [word(question)], stamp, question["question"])
        if answer is None or answer[0] == "unknown":
            self._beginning = self._beginning or beginning
            return None
        kind, tables = answer
        if kind == "empty" and self._localizing:
            self._beginning = Beginning.RESUME
            self._told(TrackingResult(stamp, TrackingState.LOST, reason="only localisation is on, and mapping has no map: give it a map_file, or call ~/localization_only with false"))
            return None
        self._stage = TrackingStage(camera, self.config, self._matcher, thorough=self._thorough)
        if kind == "resume":
            taken = tables[0].facts
            self._stage.resume(tables_update(tables[1:]), int(taken["next_map"]), int(taken["next_keyframe"]))
            self.get_logger().info("the camera is sought in the map that mapping has")
        else:
            self.get_logger().info("a new map begins")
        return self._stage

    def _track(self, stage: TrackingStage, item: Mapping[str, Any], camera: CameraModel) -> TrackingOutput:
        state = item["notice"].shutter
        if state.shutter is Shutter.CLOSED:
            return stage.hold(state.stamp_ns, state.reason)
        if item["features"].image_size != camera.image_size:
            return TrackingOutput(TrackingResult(state.stamp_ns, TrackingState.LOST, reason="image size differs from the camera's"))
        if state.shutter is Shutter.JUST_OPENED:
            stage.reopen()
        if "followed" in item:
            output = stage.process_followed(item["features"], _known(item["matches"]))
            if isinstance(output, TrackingOutput):
                self._answer(state.stamp_ns, None)
                return output
            item = self._second_round(state.stamp_ns, output) or item
        return stage.process(item["features"], _known(item["matches"]))

    def _second_round(self, stamp: int, wanted: Wanted) -> Mapping[str, Any] | None:
        """Have frontend detect in the image; features and matches, or None where it does not answer."""
        while not self._seconds.empty():  # what came too late
            self._seconds.get()
        self._second.expect(stamp)
        self._answer(stamp, wanted)
        end = time.monotonic() + PATIENCE_S
        while not self.stopping.is_set() and time.monotonic() < end:
            with suppress(queue.Empty):
                return self._seconds.get(timeout=WAKE_S)
            if self.queue is not None and len(self.queue):  # frontend has gone on to the next image
                break
        return None

    def _answer(self, stamp: int, wanted: Wanted | None) -> None:
        """Say, once, what is wanted of a frame that was followed."""
        if self._unanswered and not self.stopping.is_set():
            self._verdicts.publish(verdict_message(stamp, wanted))
        self._unanswered = False

    def _tell_mapping(self, stage: TrackingStage, output: TrackingOutput, notice: FrameNotice) -> None:
        stamp = output.result.stamp_ns
        if output.dropped_map_id is not None:
            self._send("drop", [word({"map": str(output.dropped_map_id)})], stamp)
        if output.initial_map is not None:
            kind, tables = "initial_map", initial_map_tables(output.initial_map)
        elif output.keyframe is not None:
            pose = stamped_pose(stamp, output.keyframe.world_from_camera, output.result.covariance, output.result.twist, self._place.frames)
            self._keyframe_poses.publish(odometry(header(stamp, self._place.frames.map), self._place.frames.child, pose))
            kind, tables = "keyframe", keyframe_tables(output.keyframe)
        else:
            return
        answer = self._ask_mapping(kind, tables, stamp, str(stamp))
        if answer is None:
            return
        if answer[0] == "update":
            stage.apply(tables_update(answer[1]))
        elif self._beginning is None:
            self._want(Beginning.RESUME, "mapping does not have the last keyframe, or its answer was lost")

    def _ask_mapping(self, kind: str, tables: list[Table], stamp: int, question: str) -> tuple[str, list[Table]] | None:
        """Send a record and wait for what mapping answers, to this question where it names one; None when tracking is to begin, or the node ends."""
        expected = ("resume", "empty", "unknown") if kind == "begin" else ("update", "unknown")
        while not self._updates.empty():  # answers that nobody waits for any more
            self._updates.get()
        self._send(kind, tables, stamp)
        while not self.stopping.is_set() and self._beginning is None:
            try:
                answer = self._updates.get(timeout=PATIENCE_S)
            except queue.Empty:
                self.get_logger().warning("waiting for the node mapping, which does not answer")
                self._send(*(("begin", tables, stamp) if kind == "begin" else ("known?", [word({"question": question})], stamp)))
                continue
            if answer[0] in expected and answer[1][0].facts.get("question", question) == question:
                return answer
        return None

    def _tell_frontend(self, stage: TrackingStage) -> None:
        reference = stage.reference_features
        if reference is not None and reference.stamp_ns != self._reference_ns:
            self._reference_ns = reference.stamp_ns
            self._references.publish(header(reference.stamp_ns, self._place.frames.camera))

    def _told(self, result: TrackingResult) -> None:
        if self.health.result_came(result):
            self.reporter.report()

    def _send(self, kind: str, tables: list[Table], stamp: int) -> None:
        for cloud in record_clouds(header(stamp, self._place.frames.camera), kind, tables):
            self._keyframes.publish(cloud)

    # ---- callbacks ------------------------------------------------------------------------------------------------------------------

    def _on_part(self, part: str, table: Table, read: Callable[[Table], Any]) -> None:
        value, followed = read(table), is_followed(table)
        if followed:
            self._join("followed", value.stamp_ns, True)
        elif value.stamp_ns == self._second.stamp_ns:
            both = self._second.add(part, value)
            if both is not None:
                self._seconds.put(both)
            return
        self._join(part, value.stamp_ns, value)

    def _join(self, part: str, stamp: int, value: Any) -> None:
        if not self.active:
            return
        if part == "notice":
            self.health.image_came()
        for frame in self._joiner.add(part, stamp, value):
            self.enqueue(frame)

    def _on_update(self, cloud: PointCloud2) -> None:
        record = self._assembler.add(cloud)
        if record is None:
            return
        if record[0] == "unknown" and "question" not in record[1][0].facts:  # an answer is for the thread, if it still waits
            self._want(Beginning.RESUME, "mapping was started again, or has another map")
        self._updates.put(record)  # also wakes the thread

    def _on_reset(self, _: Trigger.Request) -> str:
        if self._localizing:
            raise InputError("only localisation is on, and after a reset there would be no map: call ~/localization_only with false first")
        self._want(Beginning.RESET, "reset was called")
        return "a new map begins with the next image"

    def _on_localization_only(self, request: SetBool.Request) -> str:
        if request.data and (self._stage is None or self._stage.map_id < 0):
            raise InputError("there is no map yet in which the camera could be found: wait for one, or call ~/load_map of mapping")
        self._localizing = bool(request.data)
        return "the map stays as it is" if request.data else "the map grows"

    def _want(self, beginning: Beginning, why: str) -> None:
        self._beginning = beginning
        self.health.state = TrackingState.INITIALIZING
        self.get_logger().info(f"tracking begins again: {why}")


def _known(matches: Matches) -> Matches | None:
    """None where frontend had no reference."""
    return matches if matches.reference_stamp_ns else None


def _closed(parts: Mapping[str, Any]) -> bool:
    return "notice" in parts and parts["notice"].shutter.shutter is Shutter.CLOSED


def main() -> None:
    """The executable `tracking`."""
    sys.exit(run_node(TrackingNode))


if __name__ == "__main__":
    main()
