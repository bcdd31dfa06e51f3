"""The full adjustment after a loop or a merge, made apart from the keyframes that come meanwhile, and its result brought into the map that has grown since."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.geometry import poses
from thegra_core.map.editor import MapEditor
from thegra_core.mapping.adjustment import Adjustment, full_adjustment
from thegra_core.optimization.bundle import BundleResult
from thegra_core.optimization.solver import BundleSolver, PendingBundle

FloatArray = NDArray[np.float64]
logger = logging.getLogger(__name__)


@dataclass(slots=True)
class _Running:
    adjustment: Adjustment
    pending: PendingBundle
    keyframes_to_wait: int


class FullAdjustments:
    """At most one full adjustment a map under way.

    A result is asked for `loop.full_adjustment_after` keyframes after the start at the earliest, and then as soon as the solver has it.
    """

    def __init__(self, solver: BundleSolver, config: ThegraConfig) -> None:
        self._solver = solver
        self._config = config
        self._running: dict[int, _Running] = {}

    def start(self, editor: MapEditor) -> None:
        """Begin with the map as it is; what was under way for it is given up."""
        self.cancel(editor.map.map_id)
        adjustment = full_adjustment(editor, self._config)
        if adjustment is not None:
            self._running[editor.map.map_id] = _Running(adjustment, self._solver.submit(adjustment.task), self._config.loop.full_adjustment_after)

    def collect(self, editor: MapEditor) -> bool:
        """To be called once a keyframe: bring a result into the map if one is due and there; whether that happened."""
        running = self._running.get(editor.map.map_id)
        if running is None:
            return False
        running.keyframes_to_wait -= 1
        if running.keyframes_to_wait > 0 or not running.pending.ready:
            return False
        del self._running[editor.map.map_id]
        result = running.pending.result()
        if result is None:
            return False
        bring_in(editor, running.adjustment, result)
        return True

    def cancel(self, map_id: int) -> None:
        """Give up what is under way for a map, if anything."""
        running = self._running.pop(map_id, None)
        if running is not None:
            running.pending.cancel()


def bring_in(editor: MapEditor, adjustment: Adjustment, result: BundleResult) -> None:
    """Move the map to a result that was made of an earlier state of it.

    Keyframes that came since keep their pose relative to their reference keyframe, landmarks relative to the keyframe that saw them first, as do those that
    the adjustment could not use. What was removed since stays removed.
    """
    current = editor.map
    before = {i: keyframe.world_from_camera for i, keyframe in current.keyframes.items()}
    after = _carried(editor, before, dict(zip(adjustment.keyframe_ids.tolist(), result.world_from_camera, strict=True)))
    ids = current.landmarks.alive_ids()
    points = current.landmarks.points_world[current.landmarks.rows(ids)].copy()
    solved = np.any(result.points_world != adjustment.task.problem.points_world, axis=1)
    solved_ids = adjustment.landmark_ids[solved]
    known = np.isin(ids, solved_ids)
    points[known] = result.points_world[solved][np.searchsorted(solved_ids, ids[known])]
    carriers = np.array([editor.carrier(i) for i in ids[~known].tolist()], dtype=np.int64)
    rest = np.flatnonzero(~known)
    for carrier in np.unique(carriers).tolist():
        mine = rest[carriers == carrier]
        points[mine] = poses.apply(after[carrier] @ poses.inverse(before[carrier]), points[mine])
    keyframe_ids = np.array(sorted(after), dtype=np.int64)
    editor.move(keyframe_ids, np.stack([after[i] for i in keyframe_ids.tolist()]), ids, points)
    for landmark, keyframe_id, feature in adjustment.outlier_observations(result):
        if editor.observers.get(landmark, {}).get(keyframe_id) == feature:
            editor.forget_observation(landmark, keyframe_id)
    moved = max(float(np.linalg.norm(after[i][:3, 3] - before[i][:3, 3])) for i in after)
    logger.info("map %d: full adjustment of %d keyframes, %d more carried along; keyframes move by %.3f at most",
                current.map_id, len(adjustment.keyframe_ids), len(set(after) - set(adjustment.keyframe_ids.tolist())), moved)  # fmt: skip


def _carried(editor: MapEditor, before: dict[int, FloatArray], solved: dict[int, FloatArray]) -> dict[int, FloatArray]:
    """World_from_camera of every keyframe: solved, or carried by its reference keyframe, which came before it."""
    after: dict[int, FloatArray] = {}
    for keyframe_id in sorted(before):
        if keyframe_id in solved:
            after[keyframe_id] = solved[keyframe_id]
            continue
        reference = editor.map.keyframes[keyframe_id].reference_id
        carrier = reference if reference in after else max(after)
        after[keyframe_id] = after[carrier] @ poses.inverse(before[carrier]) @ before[keyframe_id]
    return after
