"""Keyframes in; the map's updates, its points and its keyframes' path out.

Mapping owns the map, which a process of its own keeps. Tracking asks for it when it begins (`begin`), and gets it whole (`resume`) or hears that it is `empty`; a word of a map that is not
known here is answered with `unknown`, upon which tracking begins again. Tracking that hears nothing of a keyframe asks whether it is `known?`. All that came before that
question is answered by then: the keyframe came, or its update went out, while this node was not active. So the answer is `unknown`, which tracking passes by where the update
was only late.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from thegra_core.errors import InputError, ThegraError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import InitialMap, Keyframe, MapSummary
from thegra_ros.beside import EngineError
from thegra_ros.camera_input import CameraInput
from thegra_ros.camera_place import CameraPlace
from thegra_ros.codec.clouds import Table
from thegra_ros.codec.records import Assembler, record_clouds, tables_initial_map, tables_keyframes, update_tables, word
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.lifecycle import run_node
from thegra_ros.map_keeper import Growth, Keeper, KeeperBeside, KeeperHere, Kept, Whole
from thegra_ros.node_parameters import begin_in
from thegra_ros.outputs import MapOutputs
from thegra_ros.qos import LOSSLESS
from thegra_ros.stage_node import EVERYTHING, StageNode


class MappingNode(StageNode):
    """The fourth stage."""

    queue_size = EVERYTHING  # tracking waits for each answer, so that few are ever there

    def __init__(self) -> None:
        super().__init__("mapping")
        self._keeper: Keeper | None = None
        self.offer(Trigger, "~/save_map", self._on_save_map)
        self.offer(Trigger, "~/load_map", self._on_load_map)

    def prepare(self) -> None:
        self.health.steady = False  # a camera that stands still makes no keyframes
        self._home = begin_in(self.own)
        self._place = CameraPlace(self, self.own)
        self._updates = self.publisher(PointCloud2, "map_update", LOSSLESS)
        self._outputs = MapOutputs(self)
        self._kept: Kept | None = None  # None: no map was begun, not even an empty one
        self._replaced = False  # the map was loaded, and tracking has not begun in it yet
        self._of: CameraModel | None = None
        self._map_sent_s = -np.inf
        self._camera = CameraInput(self, self.own.camera_file, self.health, lambda why: self.get_logger().info(why))
        self._assembler = Assembler()
        self._keeper = self._new_keeper()
        self.listen(PointCloud2, "keyframe", LOSSLESS, self._on_cloud)

    def load(self) -> None:
        if self._keeper is not None:
            self._keeper.start()

    def release(self) -> None:
        self.stopping.set()
        self._stop_keeper()
        super().release()
        self._stop_keeper()  # the thread may have made another one meanwhile
        self._keeper = None

    def work(self, item: tuple[str, list[Table], int, str]) -> None:
        kind, tables, stamp, frame_id = item
        self._place.see(frame_id)
        if self._of is not self._camera.camera:
            self._of, self._kept = self._camera.camera, None
        if kind == "begin":
            self._begin(tables[0], stamp)
        elif kind == "known?":
            self._send("unknown", [word({"question": tables[0].facts["question"]})], stamp)
        elif self._kept is None or self._replaced:
            self._send("unknown", [word({})], stamp)
        elif kind == "drop":
            self._kept = self._call("drop", int(tables[0].facts["map"]))
        elif kind == "initial_map":
            self._grow(tables_initial_map(tables), stamp)
        elif kind == "keyframe":
            self._grow(tables_keyframes(tables)[0], stamp)

    def begin_anew(self, why: str) -> None:
        self._kept = None
        if self._keeper is not None:  # what failed may be in any state, or gone
            self._keeper.stop()
            self._keeper = self._new_keeper()
            self._keeper.start()
        self._send("unknown", [word({})], 0)  # tracking waits for an answer

    def facts(self) -> dict[str, object]:
        kept = self._kept or Kept(0, 0)
        return {"maps": kept.maps, "loops": kept.loops, "broken records": self._assembler.broken, "camera": self._camera.described}

    # ---- the working thread ---------------------------------------------------------------------------------------------------------

    def _new_keeper(self) -> Keeper:
        return KeeperBeside(self.config) if self.own.engine == "process" else KeeperHere(self.config)

    def _stop_keeper(self) -> None:
        if self._keeper is not None:
            self._keeper.stop()

    def _call(self, method: str, *arguments: Any) -> Any:
        keeper = self._keeper
        if keeper is None:
            raise EngineError("the node ends")
        return keeper.call(method, *arguments)

    def _begin(self, wish: Table, stamp: int) -> None:
        """Give tracking what it begins with: the map that is there, that of a file, or none."""
        question = {"question": wish.facts["question"]}
        if self._of is None:
            self._send("unknown", [word(question)], stamp)
            return
        if wish.facts["beginning"] == "reset":
            self._home = None
        if self._kept is None or wish.facts["beginning"] != "resume":
            try:
                self._kept = self._call("begin", self._of, self._home)
            except ThegraError as error:  # tracking asks again
                self.tell(str(error))
                return
        self._replaced = False
        whole: Whole | None = self._call("whole")
        if whole is None:
            self._outputs.forget()
            self._send("empty", [word(question)], stamp)
            return
        taken = {**question, "next_map": str(whole.next_map), "next_keyframe": str(whole.next_keyframe)}
        self._send("resume", [word(taken), *update_tables(whole.update)], stamp)
        self._show(whole.summary, stamp)

    def _grow(self, by: InitialMap | Keyframe, stamp: int) -> None:
        growth: Growth | None = self._call("grow", by, time.monotonic() - self._map_sent_s >= self.own.map_period_s)
        if growth is None:
            self.get_logger().warning("a keyframe of a map that is not known here came: tracking is asked to begin again")
            self._send("unknown", [word({})], stamp)
            return
        self._kept = growth.kept
        self._send("update", update_tables(growth.update), stamp)
        if growth.summary is not None:
            self._show(growth.summary, stamp)

    def _show(self, summary: MapSummary, stamp: int) -> None:
        self._map_sent_s = time.monotonic()
        self._outputs.publish(stamp, summary, self._place.frames)

    def _save(self, path: Path) -> str:
        if self._kept is None:
            raise InputError(f"there is no map yet that could be written to {path}")
        self._call("save", path)
        return f"the map is in {path}"

    def _load(self, path: Path) -> str:
        camera = self._camera.camera
        if camera is None:
            raise InputError(f"a map belongs to a camera, and there is none yet: {self.health.camera_trouble}")
        self._kept = self._call("begin", camera, path)
        self._of, self._home, self._replaced = camera, path, True
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
