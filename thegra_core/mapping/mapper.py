"""The mapping stage: owns the maps, grows and adjusts them, and tells tracking what changed."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from itertools import takewhile
from pathlib import Path

import numpy as np

from thegra_core.config import ThegraConfig
from thegra_core.errors import InputError
from thegra_core.features.protocols import Matcher
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.editor import MapEditor
from thegra_core.map.map import Map, summarize
from thegra_core.map.orientation import lie_alike
from thegra_core.mapping import culling
from thegra_core.mapping.adjustment import adjust_all, adjust_locally
from thegra_core.mapping.chaining import MatchGraph
from thegra_core.mapping.expansion import expand
from thegra_core.mapping.full_adjustment import FullAdjustments
from thegra_core.mapping.loop_closing import LoopCloser
from thegra_core.mapping.merging import MapMerger, merge
from thegra_core.mapping.persistence import KeptMap, load_map, save_map
from thegra_core.messages import Absorbed, InitialMap, Keyframe, MapSummary, MapUpdate
from thegra_core.optimization.solver import BundleSolver, InlineSolver

logger = logging.getLogger(__name__)


def _nobody_waits() -> bool:
    return False


class Mapper:
    """Keyframes in, map updates out (paper Sec. III-C). Not thread-safe: one caller at a time.

    Args:
        solver: Makes the full adjustments after loops and merges. The default makes them in the calling thread, at a fixed keyframe: a run can be repeated.
    """

    def __init__(self, camera: CameraModel, config: ThegraConfig, matcher: Matcher, solver: BundleSolver | None = None) -> None:
        self._camera = camera
        self._config = config
        self._matcher = matcher
        self._editors: dict[int, MapEditor] = {}
        self._trial: dict[int, list[int]] = {}
        self._graphs: dict[int, MatchGraph] = {}
        self._loops: dict[int, LoopCloser] = {}
        self._merger = MapMerger(config, matcher)
        self._full = FullAdjustments(solver or InlineSolver(), config)
        self.merges = 0

    def initialize(self, initial: InitialMap) -> MapUpdate:
        """Begin a map from what the initializer solved; its bundle adjustment has been done."""
        editor = MapEditor(initial.map_id, self._camera, self._config.mapping.covisibility_threshold)
        self._editors[initial.map_id] = editor
        for message in initial.keyframes:
            editor.add_keyframe(message)
        ids = editor.add_landmarks(initial.points_world, initial.keyframes[-1].id)
        for message in initial.keyframes:
            for feature in np.flatnonzero(message.landmark_ids >= 0).tolist():
                editor.observe(int(ids[message.landmark_ids[feature]]), message.id, feature)
        editor.remove_landmarks([i for i in ids.tolist() if len(editor.observers[i]) < 2])
        for message in initial.keyframes:
            editor.connect(message.id)
        self._trial[initial.map_id] = []
        self._graphs[initial.map_id] = MatchGraph()
        self._loops[initial.map_id] = LoopCloser(self._config, self._matcher)
        for message in initial.keyframes:
            self._loops[initial.map_id].index.add(message.id, message.features)
        for message in initial.keyframes:
            if message.reference_matches is not None:
                self._graphs[initial.map_id].add(message.id, message.reference_id, message.reference_matches)
        logger.info("map %d begins with %d keyframes and %d landmarks", initial.map_id, len(initial.keyframes), len(editor.map.landmarks))
        return editor.take_update()

    def insert(self, keyframe: Keyframe) -> MapUpdate:
        """Insert a keyframe: observations, culling, expansion with its neighbours, local bundle adjustment; then what it may tie together."""
        deque(self._grow(keyframe, _nobody_waits), maxlen=0)
        self._settle(keyframe)
        tied = self._tie(keyframe)
        return tied if tied is not None else self._editors[keyframe.map_id].take_update()

    def grow(self, keyframe: Keyframe, others_wait: Callable[[], bool] = _nobody_waits) -> Iterator[MapUpdate]:
        """The first step of `insert`, for a tracker that waits for the new landmarks, which are not adjusted yet: first those of the matches that it made itself,
        then those of the matches that had to be made, of which no more are made once others wait."""
        for _ in self._grow(keyframe, others_wait):
            yield self._editors[keyframe.map_id].take_update()

    def settle(self, keyframe: Keyframe) -> MapUpdate:
        """The second step, the local adjustment. It may be left out: that of a later keyframe takes in this one, its neighbour."""
        self._settle(keyframe)
        return self._editors[keyframe.map_id].take_update()

    def tie(self, keyframe: Keyframe) -> MapUpdate | None:
        """The third step, loops and merges, for a keyframe that is settled; None if it ties nothing. It may be left out, too."""
        before = self.loops
        tied = self._tie(keyframe)
        return self._editors[keyframe.map_id].take_update() if tied is None and self.loops != before else tied

    def _grow(self, keyframe: Keyframe, others_wait: Callable[[], bool]) -> Iterator[None]:
        """Stops where landmarks have come."""
        editor = self._editors[keyframe.map_id]
        keyframe = editor.carried(keyframe)
        editor.add_keyframe(keyframe)
        editor.connect(keyframe.id)
        self._cull(editor, keyframe)
        yield from self._expand(editor, keyframe, others_wait)
        editor.connect(keyframe.id)
        self._thin(editor, keyframe.id)
        self._loops[keyframe.map_id].index.add(keyframe.id, keyframe.features)
        yield

    def _settle(self, keyframe: Keyframe) -> None:
        """A full adjustment that is done comes in before the local one, which smooths the seams to what has come since."""
        editor = self._editors[keyframe.map_id]
        self._full.collect(editor)
        adjust_locally(editor, keyframe.id, self._config)
        editor.adjusted_id = keyframe.id
        editor.connect(keyframe.id)

    def _tie(self, keyframe: Keyframe) -> MapUpdate | None:
        """Close loops; the whole of an older map if this keyframe ties its map to that one."""
        editor, loops = self._editors[keyframe.map_id], self._loops[keyframe.map_id]
        if not self._config.loop.enabled:
            return None
        if loops.look(editor, keyframe.id, self._graphs[keyframe.map_id]):
            self._full.start(editor)
        return self._merge(editor, keyframe.id)

    def finish(self, map_id: int) -> MapUpdate:
        """Full bundle adjustment of a map at the end of a run."""
        editor = self._editors[map_id]
        self._full.cancel(map_id)
        adjust_all(editor, self._config)
        return editor.take_update()

    def save(self, map_id: int, path: Path) -> None:
        """Write a map to one file; the map goes on as it is.

        Raises:
            InputError: If the file cannot be written.
        """
        kept = KeptMap(self._editors[map_id], self._graphs[map_id], self._loops[map_id].index, self._trial[map_id])
        save_map(path, kept, self._config)

    def save_largest(self, path: Path) -> None:
        """Write the largest map.

        Raises:
            InputError: If there is none, or the file cannot be written.
        """
        if not self._editors:
            raise InputError(f"there is no map yet that could be written to {path}")
        self.save(self.largest, path)

    @property
    def largest(self) -> int:
        """The map with most keyframes, the older of equals; there has to be one."""
        return max(self._editors, key=lambda i: (len(self._editors[i].map.keyframes), -i))

    def load(self, path: Path) -> MapUpdate:
        """Take a map from a file, beside those that are there; returns the whole of it as an update.

        Raises:
            InputError: If the file is not there, not whole, or of another version, camera or extractor.
        """
        map_id = max(self._editors, default=-1) + 1
        loops = LoopCloser(self._config, self._matcher)
        kept = load_map(path, map_id, self._camera, self._config, loops.index)
        self._editors[map_id], self._graphs[map_id], self._trial[map_id], self._loops[map_id] = kept.editor, kept.graph, kept.trial, loops
        logger.info("%s: %d keyframes and %d landmarks", path, len(kept.editor.map.keyframes), len(kept.editor.map.landmarks))
        return kept.editor.take_update()

    def whole(self, map_id: int) -> MapUpdate:
        """All of a map as an update, for a replica that begins."""
        editor = self._editors[map_id]
        editor.touch_all()
        return editor.take_update()

    def drop(self, map_id: int) -> None:
        """Forget a map that tracking has given up; one that has become part of another meanwhile stays that."""
        if map_id not in self._editors:
            return
        self._full.cancel(map_id)
        del self._editors[map_id], self._trial[map_id], self._graphs[map_id], self._loops[map_id]

    @property
    def loops(self) -> int:
        """Loops closed in all maps."""
        return sum(loops.closed for loops in self._loops.values())

    @property
    def map_ids(self) -> list[int]:
        return sorted(self._editors)

    def map(self, map_id: int) -> Map:
        """The map itself; the caller reads it and changes nothing."""
        return self._editors[map_id].map

    def summary(self, map_id: int) -> MapSummary:
        """A copy of what a map holds, for outputs."""
        return summarize(self._editors[map_id].map)

    def _merge(self, editor: MapEditor, keyframe_id: int) -> MapUpdate | None:
        """The whole of an older map that a map has become part of, if this keyframe ties them."""
        map_id = editor.map.map_id
        others = {i: (self._editors[i].map, self._loops[i].index) for i in self._editors if i != map_id}
        tie = self._merger.find(editor.map, keyframe_id, others)
        if tie is None:
            return None
        old, similarity = self._editors[tie.old_map_id], tie.old_from_new(editor.map)
        renamed = merge(old, editor, tie, self._config)
        graph = self._graphs[tie.old_map_id]
        graph.absorb(self._graphs[map_id])
        for sighting in tie.sightings:
            for other, matches in sighting.matches.items():
                graph.add(sighting.keyframe_id, other, matches)
        for i, joined in sorted(editor.map.keyframes.items()):
            self._loops[tie.old_map_id].index.add(i, joined.features)
        self._loops[tie.old_map_id].closed += self._loops[map_id].closed
        self._trial[tie.old_map_id].extend(renamed[i] for i in self._trial[map_id] if i in renamed)
        self.drop(map_id)
        self._full.start(old)
        self.merges += 1
        return old.take_update(Absorbed(map_id, similarity.rigid, similarity.scale))

    def _cull(self, editor: MapEditor, keyframe: Keyframe) -> None:
        trial = self._trial[keyframe.map_id]
        if keyframe.seen is not None:
            concerned = culling.count_visibility(editor, keyframe.seen)
            editor.remove_landmarks(culling.untrackable(editor, concerned, self._config.mapping))
        remove, self._trial[keyframe.map_id] = culling.failed_trial(editor, trial, keyframe.id, self._config.mapping)
        editor.remove_landmarks(remove)

    def _thin(self, editor: MapEditor, keyframe_id: int) -> None:
        """Let redundant keyframes go; the newest stay, which tracking and the search for loops hold on to."""
        for removed in culling.remove_redundant(editor, keyframe_id, self._config.mapping):
            self._graphs[editor.map.map_id].remove(removed)
            self._loops[editor.map.map_id].index.remove(removed)

    def _expand(self, editor: MapEditor, keyframe: Keyframe, others_wait: Callable[[], bool]) -> Iterator[None]:
        """Match the keyframe to its neighbours, the reference first, whose matches tracking already has, and through them to theirs; stops after the reference.

        The neighbours are matched in the order of what they are worth, until others wait: a network takes as long for each as tracking for a frame.
        """
        neighbours = self._choose_neighbours(editor, keyframe)
        graph, before, count = self._graphs[keyframe.map_id], editor.next_landmark, self._config.mapping.neighbours
        if keyframe.reference_matches is not None and keyframe.reference_id in editor.map.keyframes:
            graph.add(keyframe.id, keyframe.reference_id, keyframe.reference_matches)
            expand(editor, keyframe.id, keyframe.reference_id, keyframe.reference_matches, self._config.mapping)
            neighbours, count = [i for i in neighbours if i != keyframe.reference_id], count - 1
            yield
        known = [(i, self._matcher.match(keyframe.features, editor.map.keyframes[i].features)) for i in takewhile(lambda _: not others_wait(), neighbours[:count])]
        for neighbour, matches in known:
            graph.add(keyframe.id, neighbour, matches)
        for other, matches in [*known, *graph.chained(keyframe.id, self._config.mapping.chained_keyframes)]:
            expand(editor, keyframe.id, other, matches, self._config.mapping)
        self._trial[keyframe.map_id].extend(range(before, editor.next_landmark))

    def _choose_neighbours(self, editor: MapEditor, keyframe: Keyframe) -> list[int]:
        """Covisible keyframes to match: those that lie alike, share much and stand far enough apart for new points to have parallax.

        A neighbour counts by the landmarks it shares, less in proportion the shorter its baseline is than `good_baseline_ratio` of the scene's depth: where
        keyframes follow each other closely, the nearest share most and tell least.
        """
        settings = self._config.mapping
        depth = editor.map.median_depth(keyframe.id)
        center, turns = editor.map.keyframes[keyframe.id].center, keyframe.features.turns
        good = settings.good_baseline_ratio * depth if np.isfinite(depth) else 0.0
        worth = []
        for other, shared in editor.map.covisibility.get(keyframe.id, ()):
            neighbour = editor.map.keyframes[other]
            if not lie_alike(neighbour, keyframe.world_from_camera, turns):
                continue
            baseline = float(np.linalg.norm(neighbour.center - center))
            worth.append((shared * min(1.0, baseline / good) if good > 0 else float(shared), other))
        return [other for _, other in sorted(worth, reverse=True)[: settings.neighbours]]
