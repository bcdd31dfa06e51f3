"""Keyframes in; the map's updates, its points and its keyframes' path out.

Mapping owns the map. Tracking asks for it when it begins (`begin`), and gets it whole (`resume`) or hears that it is `empty`; a word of a map that is not
known here is answered with `unknown`, upon which tracking begins again.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from thegra_core.errors import InputError, ThegraError
from thegra_core.features.registry import make_matcher
from thegra_core.geometry.camera import CameraModel
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import MapUpdate
from thegra_core.optimization.solver import ProcessSolver
from thegra_ros.camera_input import CameraInput
from thegra_ros.camera_place import CameraPlace
from thegra_ros.codec.clouds import Table
from thegra_ros.codec.records import Assembler, record_clouds, tables_initial_map, tables_keyframes, update_tables, word
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.lifecycle import run_node
from thegra_ros.node_parameters import begin_in
from thegra_ros.outputs import MapOutputs
from thegra_ros.qos import LOSSLESS
from thegra_ros.stage_node import EVERYTHING, StageNode


class MappingNode(StageNode):
    """The fourth stage."""

    queue_size = EVERYTHING  # tracking waits for each answer, so that few are ever there

    def __init__(self) -> None:
        super().__init__("mapping")
        self.offer(Trigger, "~/save_map", self._on_save_map)
        self.offer(Trigger, "~/load_map", self._on_load_map)

    def prepare(self) -> None:
        self._home = begin_in(self.own)
        self._place = CameraPlace(self, self.own)
        self._updates = self.publisher(PointCloud2, "map_update", LOSSLESS)
        self._outputs = MapOutputs(self)
        self._mapper: Mapper | None = None
        self._replaced = False  # the map was loaded, and tracking has not begun in it yet
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
        if self._of is not self._camera.camera:
            self._of, self._mapper = self._camera.camera, None
        if kind == "begin":
            self._begin(tables[0], stamp)
        elif self._mapper is None or self._replaced:
            self._send("unknown", [word({})], stamp)
        elif kind == "drop" and int(tables[0].facts["map"]) in self._mapper.map_ids:
            self._mapper.drop(int(tables[0].facts["map"]))
        elif kind in ("initial_map", "keyframe"):
            self._grow(self._mapper, kind, tables, stamp)

    def begin_anew(self, why: str) -> None:
        self._mapper = None
        self._send("unknown", [word({})], 0)  # tracking waits for an answer

    def facts(self) -> dict[str, object]:
        maps = self._mapper.map_ids if self._mapper is not None else []
        return {"maps": len(maps), "loops": self._mapper.loops if self._mapper is not None else 0, "broken records": self._assembler.broken}

    # ---- the working thread ---------------------------------------------------------------------------------------------------------

    def _begin(self, wish: Table, stamp: int) -> None:
        """Give tracking what it begins with: the map that is there, that of a file, or none."""
        question = {"question": wish.facts["question"]}
        if self._of is None:
            self._send("unknown", [word(question)], stamp)
            return
        if wish.facts["beginning"] == "reset":
            self._home = None
        if self._mapper is None or wish.facts["beginning"] != "resume":
            try:
                self._mapper = self._new(self._of, self._home)
            except ThegraError as error:  # tracking asks again
                self.tell(str(error))
                return
        mapper, self._replaced = self._mapper, False
        if not mapper.map_ids:
            self._send("empty", [word(question)], stamp)
            return
        main = mapper.largest
        keyframes = max(max(mapper.map(i).keyframes) for i in mapper.map_ids)
        taken = {**question, "next_map": str(max(mapper.map_ids) + 1), "next_keyframe": str(keyframes + 1)}
        self._send("resume", [word(taken), *update_tables(mapper.whole(main))], stamp)
        self._show(mapper, main, stamp)

    def _new(self, camera: CameraModel, home: Path | None) -> Mapper:
        made = Mapper(camera, self.config, self._matcher, ProcessSolver())
        if home is not None:
            made.load(home)
        return made

    def _grow(self, mapper: Mapper, kind: str, tables: list[Table], stamp: int) -> None:
        update: MapUpdate | None = None
        if kind == "initial_map":
            update = mapper.initialize(tables_initial_map(tables))
        else:
            (keyframe,) = tables_keyframes(tables)
            update = mapper.insert(keyframe) if keyframe.map_id in mapper.map_ids else None
        if update is None:
            self.get_logger().warning("a keyframe of a map that is not known here came: tracking is asked to begin again")
            self._send("unknown", [word({})], stamp)
            return
        self._send("update", update_tables(update), stamp)
        if time.monotonic() - self._map_sent_s >= self.own.map_period_s:
            self._show(mapper, update.map_id, stamp)

    def _show(self, mapper: Mapper, map_id: int, stamp: int) -> None:
        self._map_sent_s = time.monotonic()
        self._outputs.publish(stamp, mapper.summary(map_id), self._place.frames)

    def _save(self, path: Path) -> str:
        if self._mapper is None:
            raise InputError(f"there is no map yet that could be written to {path}")
        self._mapper.save_largest(path)
        return f"the map is in {path}"

    def _load(self, path: Path) -> str:
        camera = self._camera.camera
        if camera is None:
            raise InputError(f"a map belongs to a camera, and there is none yet: {self.health.camera_trouble}")
        self._of, self._mapper = camera, self._new(camera, path)
        self._home, self._replaced = path, True
        self._send("unknown", [word({})], 0)  # tracking begins again, in this map
        return f"the camera is sought in the map of {path}"

    def _send(self, kind: str, tables: list[Table], stamp: int) -> None:
        for cloud in record_clouds(header(stamp, self._place.frames.map), kind, tables):
            self._updates.publish(cloud)

    # ---- callbacks ------------------------------------------------------------------------------------------------------------------

    async def _on_save_map(self, _: Trigger.Request) -> str:
        path = self.settings.map_file
        return await self.ask(lambda: self._save(path))

    async def _on_load_map(self, _: Trigger.Request) -> str:
        path = self.settings.map_file
        return await self.ask(lambda: self._load(path))

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
