"""Keyframes in; the map's updates, its points and its keyframes' path out."""

from __future__ import annotations

import sys
import time

import numpy as np
from sensor_msgs.msg import PointCloud2

from thegra_core.features.registry import make_matcher
from thegra_core.geometry.camera import CameraModel
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import MapUpdate
from thegra_core.optimization.solver import ProcessSolver
from thegra_ros.camera_input import CameraInput
from thegra_ros.camera_place import CameraPlace
from thegra_ros.codec.clouds import Table
from thegra_ros.codec.records import Assembler, record_clouds, tables_initial_map, tables_keyframes, update_tables
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.lifecycle import run_node
from thegra_ros.outputs import MapOutputs
from thegra_ros.qos import LOSSLESS
from thegra_ros.stage_node import EVERYTHING, StageNode


class MappingNode(StageNode):
    """The fourth stage."""

    queue_size = EVERYTHING

    def __init__(self) -> None:
        super().__init__("mapping")

    def prepare(self) -> None:
        self._place = CameraPlace(self, self.own)
        self._updates = self.publisher(PointCloud2, "map_update", LOSSLESS)
        self._outputs = MapOutputs(self)
        self._mapper: Mapper | None = None
        self._of: CameraModel | None = None
        self._map_sent_s = -np.inf
        self._camera = CameraInput(self, self.own.camera_file, self.health, lambda why: self.get_logger().info(why))
        self._assembler = Assembler()
        self.listen(PointCloud2, "keyframe", LOSSLESS, self._on_cloud)

    def load(self) -> None:
        self._matcher = make_matcher(self.config.matcher, self.config.extractor)

    def work(self, item: tuple[str, list[Table], int, str]) -> None:
        kind, tables, stamp, frame_id = item
        self._place.see(frame_id)
        if kind == "reset" or self._of is not self._camera.camera:
            self._of = self._camera.camera
            self._mapper = Mapper(self._of, self.config, self._matcher, ProcessSolver()) if self._of is not None else None
        if kind == "drop" and self._mapper is not None and int(tables[0].facts["map"]) in self._mapper.map_ids:
            self._mapper.drop(int(tables[0].facts["map"]))
        if kind in ("initial_map", "keyframe"):
            self._grow(kind, tables, stamp)

    def begin_anew(self, why: str) -> None:
        self._mapper = None
        self._send("unknown", [Table({"id": np.empty(0, np.int64)}, {})], 0)  # tracking waits for an answer

    def facts(self) -> dict[str, object]:
        maps = self._mapper.map_ids if self._mapper is not None else []
        return {"maps": len(maps), "loops": self._mapper.loops if self._mapper is not None else 0, "broken records": self._assembler.broken}

    def _grow(self, kind: str, tables: list[Table], stamp: int) -> None:
        mapper = self._mapper
        update: MapUpdate | None = None
        if mapper is not None and kind == "initial_map":
            update = mapper.initialize(tables_initial_map(tables))
        elif mapper is not None:
            (keyframe,) = tables_keyframes(tables)
            update = mapper.insert(keyframe) if keyframe.map_id in mapper.map_ids else None
        if mapper is None or update is None:
            self.get_logger().warning("a keyframe of a map that is not known here came: tracking is asked to begin anew")
            self._send("unknown", [Table({"id": np.empty(0, np.int64)}, {})], stamp)
            return
        self._send("update", update_tables(update), stamp)
        if time.monotonic() - self._map_sent_s >= self.own.map_period_s:
            self._map_sent_s = time.monotonic()
            self._outputs.publish(stamp, mapper.summary(update.map_id), self._place.frames)

    def _send(self, kind: str, tables: list[Table], stamp: int) -> None:
        for cloud in record_clouds(header(stamp, self._place.frames.map), kind, tables):
            self._updates.publish(cloud)

    def _on_cloud(self, cloud: PointCloud2) -> None:
        if not self.active:
            return
        self.health.image_came()
        record = self._assembler.add(cloud)
        if record is not None:
            self.enqueue((*record, stamp_ns(cloud), cloud.header.frame_id))


def main() -> None:
    """The executable `mapping`."""
    sys.exit(run_node(MappingNode))


if __name__ == "__main__":
    main()
