"""Loops: a place seen again ties the map's newest part to an old one, and what has drifted between is set right."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.editor import MapEditor
from thegra_core.mapping.adjustment import adjust_locally
from thegra_core.mapping.chaining import MatchGraph
from thegra_core.messages import NO_LANDMARK, Revisit
from thegra_core.optimization.pose_graph import Edge, optimize_pose_graph
from thegra_core.places.index import PlaceIndex
from thegra_core.places.verification import Sighting, agree, drift_of, sight

logger = logging.getLogger(__name__)
ESSENTIAL_NEIGHBOURS = 5
"""Best neighbours of a keyframe whose edges carry the pose graph."""


@dataclass
class LoopCloser:
    """Looks for loops of one map, keyframe by keyframe, and closes them.

    A loop takes two keyframes: one waits until the next that sees the same old place moves the map alike.
    """

    config: ThegraConfig
    matcher: Matcher
    index: PlaceIndex = field(init=False)
    closed: int = 0
    _waiting: Sighting | None = None

    def __post_init__(self) -> None:
        self.index = PlaceIndex(self.config.loop, self.config.seed)

    def look(self, editor: MapEditor, keyframe_id: int, graph: MatchGraph) -> bool:
        """Whether a keyframe of the index, which mapping has finished with, closed a loop."""
        sighting = self._find(editor, keyframe_id)
        before, self._waiting = self._waiting, sighting
        if before is None or sighting is None or not {before.keyframe_id, *before.matches} <= editor.map.keyframes.keys() or not agree(editor.map, before, sighting, self.config):
            return False
        _close(editor, [before, sighting], graph, self.config)
        self._waiting = None
        self.closed += 1
        return True

    def _find(self, editor: MapEditor, keyframe_id: int) -> Sighting | None:
        current = editor.map
        direct = current.neighbours(keyframe_id, len(current.keyframes))
        connected = list(dict.fromkeys([*direct, *(second for first in direct for second in current.neighbours(first, len(current.keyframes)))]))
        for candidate in self.index.candidates(keyframe_id, connected)[:1]:
            near = [i for i in current.neighbours(candidate, len(current.keyframes)) if i not in connected]
            found = sight(current, keyframe_id, current, [candidate, *near[: self.config.loop.group - 1]], self.matcher, self.config)
            if isinstance(found, Sighting):
                drift = drift_of(current, found)
                if drift.is_possible(self.config.loop):
                    return found
                found = f"{len(found.keypoints)} landmarks agree, {found.visible} should be seen from there, but would {drift}"
            logger.info("keyframe %d looks like %d: %s", keyframe_id, candidate, found)
        return None


def _close(editor: MapEditor, sightings: list[Sighting], graph: MatchGraph, config: ThegraConfig) -> None:
    current = editor.map
    before = {i: Similarity(keyframe.world_from_camera) for i, keyframe in current.keyframes.items()}
    drift = drift_of(current, sightings[-1])
    depth = current.median_depth(sightings[-1].keyframe_id)
    after = optimize_pose_graph(before, _edges(editor, before, sightings), min(before), depth)
    moves = {i: node @ before[i].inverse() for i, node in after.items()}
    _move(editor, after, moves)
    editor.note_moves(moves)
    for sighting in sightings:
        for other, matches in sighting.matches.items():
            graph.add(sighting.keyframe_id, other, matches)
        fuse_sighting(editor, sighting)
    concerned = {i for sighting in sightings for i in (sighting.keyframe_id, *sighting.matches)}
    for keyframe_id in sorted(concerned | {n for i in concerned for n in current.neighbours(i, ESSENTIAL_NEIGHBOURS)}):
        editor.connect(keyframe_id)
    last = sightings[-1]
    adjust_both_sides(editor, last, config)
    moved = float(np.linalg.norm(current.keyframes[last.keyframe_id].center - before[last.keyframe_id].rigid[:3, 3])) / depth
    keyframe, old_id, scale = current.keyframes[last.keyframe_id], next(iter(last.matches)), last.world_from_camera.scale
    editor.note(Revisit(keyframe.stamp_ns, current.map_id, keyframe.id, old_id, len(last.keypoints), moved, scale))
    logger.info(
        "loop closed: keyframe %d sees what keyframe %d saw, by %d landmarks of %d that should be seen from there, which %s; it moves by %.3f of the scene's depth, scale %.3f",
        keyframe.id, old_id, len(last.keypoints), last.visible, drift, moved, scale,
    )  # fmt: skip


def _edges(editor: MapEditor, world_from: dict[int, Similarity], sightings: list[Sighting]) -> list[Edge]:
    """The map's best edges as they are, and those of the sightings as they should be."""
    pairs = {
        (min(i, other), max(i, other)) for i in world_from for other in editor.map.neighbours(i, ESSENTIAL_NEIGHBOURS) if other in world_from
    }  # fmt: skip
    ordered = sorted(world_from)
    pairs |= set(pairwise(ordered))
    edges = [Edge(a, b, world_from[a].inverse() @ world_from[b]) for a, b in sorted(pairs)]
    for sighting in sightings:
        edges += [Edge(other, sighting.keyframe_id, world_from[other].inverse() @ sighting.world_from_camera) for other in sighting.matches]
    return edges


def _move(editor: MapEditor, after: dict[int, Similarity], moves: dict[int, Similarity]) -> None:
    """Carry poses, and each landmark with the keyframe that saw it first."""
    current = editor.map
    ids = current.landmarks.alive_ids()
    points = current.landmarks.points_world[current.landmarks.rows(ids)].copy()
    carriers = np.array([editor.carrier(i) for i in ids.tolist()], dtype=np.int64)
    for carrier in np.unique(carriers).tolist():
        mine = carriers == carrier
        points[mine] = moves[carrier].apply(points[mine])
    keyframes = np.array(sorted(after), dtype=np.int64)
    editor.move(keyframes, np.stack([after[i].rigid for i in keyframes.tolist()]), ids, points)


def adjust_both_sides(editor: MapEditor, sighting: Sighting, config: ThegraConfig) -> None:
    """Local adjustments where an old place and a new one have met."""
    for keyframe_id in (next(iter(sighting.matches)), sighting.keyframe_id):
        adjust_locally(editor, keyframe_id, config)
        editor.connect(keyframe_id)


def fuse_sighting(editor: MapEditor, sighting: Sighting) -> None:
    """The old landmarks of a sighting take the place of the new ones."""
    own = editor.map.keyframes[sighting.keyframe_id].landmark_ids
    for keypoint, old in zip(sighting.keypoints.tolist(), sighting.landmarks.tolist(), strict=True):
        new = int(own[keypoint])
        if old not in editor.observers:
            continue
        if new == NO_LANDMARK:
            editor.observe(old, sighting.keyframe_id, keypoint)
        else:
            editor.fuse(old, new)
