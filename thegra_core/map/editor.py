"""The owner's way to change a map: every change goes through here, so that observations stay consistent and replicas hear of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.camera import CameraModel
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.map import Map, make_keyframes
from thegra_core.messages import NO_LANDMARK, Absorbed, Keyframe, KeyframeState, LandmarkArrays, MapUpdate, RemovedKeyframe, Revisit

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class MapEditor:
    """A map with its observations in both directions and the record of what changed since the last update.

    `observers[landmark id]` is {keyframe id: keypoint index}, the mirror of the keyframes' `landmark_ids`; `visible` and `found` count
    per landmark in how many frames it was predicted visible and found.
    """

    def __init__(self, map_id: int, camera: CameraModel, covisibility_threshold: int) -> None:
        self.map = Map(map_id, camera)
        self.observers: dict[int, dict[int, int]] = {}
        self.visible: Counter[int] = Counter()
        self.found: Counter[int] = Counter()
        self.first_keyframe: dict[int, int] = {}
        self._threshold = covisibility_threshold
        self._next_landmark = 0
        self._new: list[Keyframe] = []
        self._keyframes: set[int] = set()
        self._landmarks: set[int] = set()
        self._removed: set[int] = set()
        self._removed_keyframes: dict[int, RemovedKeyframe] = {}
        self._revisits: list[Revisit] = []
        self.adjusted_id = -1
        self._edges: set[int] = set()
        self._scales: dict[int, float] = {}
        self._moves: list[tuple[int, dict[int, Similarity]]] = []

    @classmethod
    def restored(
        cls,
        map_id: int,
        camera: CameraModel,
        covisibility_threshold: int,
        keyframes: Sequence[Keyframe],
        landmarks: LandmarkArrays,
        covisibility: Mapping[int, tuple[tuple[int, int], ...]],
        counts: tuple[IntArray, IntArray, IntArray],
        next_landmark: int,
    ) -> MapEditor:
        """A map that was kept. All of it counts as changed.

        Args:
            counts: Per landmark (L,) the keyframe that saw it first, in how many frames it was predicted visible, and in how many found.
            next_landmark: The id that the next new landmark gets.
        """
        editor = cls(map_id, camera, covisibility_threshold)
        ids = landmarks.ids.tolist()
        editor.observers = {i: {} for i in ids}
        editor.map.keyframes = {keyframe.id: keyframe for keyframe in make_keyframes(keyframes, camera)}
        editor._new.extend(keyframes)
        editor._keyframes.update(editor.map.keyframes)
        for message in keyframes:
            for feature in np.flatnonzero(message.landmark_ids != NO_LANDMARK).tolist():
                editor.observers[int(message.landmark_ids[feature])][message.id] = feature
        editor.map.landmarks.put(landmarks)
        first, visible, found = (values.tolist() for values in counts)
        editor.first_keyframe = dict(zip(ids, first, strict=True))
        editor.visible, editor.found = Counter(dict(zip(ids, visible, strict=True))), Counter(dict(zip(ids, found, strict=True)))
        editor._landmarks.update(ids)
        editor._next_landmark = next_landmark
        editor.map.covisibility = dict(covisibility)
        editor._edges.update(covisibility)
        return editor

    # ---- changes --------------------------------------------------------------------------------------------------------------------

    def add_keyframe(self, message: Keyframe) -> None:
        """Insert a keyframe with those of its observations whose landmarks still live."""
        (keyframe,) = make_keyframes([message], self.map.camera)
        wanted = keyframe.landmark_ids.copy()
        keyframe.landmark_ids[:] = NO_LANDMARK
        self.map.keyframes[message.id] = keyframe
        self._new.append(message)
        self._keyframes.add(message.id)
        for index in np.flatnonzero(self.map.landmarks.rows(wanted) >= 0):
            self.observe(int(wanted[index]), message.id, int(index))

    def remove_keyframe(self, keyframe_id: int) -> None:
        """Take out a keyframe with its observations; its best neighbour, or else the nearest id, inherits what is placed beside it.

        Landmarks left with fewer than two observations are removed. The last keyframe of a map cannot be removed.
        """
        keyframe = self.map.keyframes[keyframe_id]
        for landmark in keyframe.landmark_ids[keyframe.landmark_ids != NO_LANDMARK].tolist():
            self.forget_observation(landmark, keyframe_id)
        neighbours = self.map.neighbours(keyframe_id, 1) or [min((i for i in self.map.keyframes if i != keyframe_id), key=lambda i: abs(i - keyframe_id))]
        heir = self.map.keyframes[neighbours[0]]
        heir_from_removed = heir.camera_from_world @ keyframe.world_from_camera
        for earlier in [r for r in self._removed_keyframes.values() if r.heir_id == keyframe_id]:
            self._removed_keyframes[earlier.id] = replace(earlier, heir_id=heir.id, heir_from_removed=heir_from_removed @ earlier.heir_from_removed)
        self._removed_keyframes[keyframe_id] = RemovedKeyframe(keyframe_id, keyframe.stamp_ns, heir.id, heir_from_removed)
        del self.map.keyframes[keyframe_id]
        for other, _ in self.map.covisibility.pop(keyframe_id, ()):
            self.map.covisibility[other] = tuple(item for item in self.map.covisibility[other] if item[0] != keyframe_id)
            self._edges.add(other)
        self._new = [message for message in self._new if message.id != keyframe_id]
        self._keyframes.discard(keyframe_id)
        self._edges.discard(keyframe_id)

    def add_landmarks(self, points_world: FloatArray, keyframe_id: int) -> IntArray:
        """New ids (N,) for points (N, 3), without observations yet; `keyframe_id` is where they were first seen."""
        ids = np.arange(self._next_landmark, self._next_landmark + len(points_world), dtype=np.int64)
        self._next_landmark += len(points_world)
        template = next(iter(self.map.keyframes.values())).features.descriptors
        self.map.landmarks.put(
            LandmarkArrays(
                ids=ids,
                points_world=np.asarray(points_world, dtype=np.float64),
                normals=np.zeros((len(ids), 3)),
                depth_min=np.zeros(len(ids)),
                depth_max=np.zeros(len(ids)),
                descriptors=np.zeros((len(ids), template.shape[1]), dtype=template.dtype),
                scores=np.zeros(len(ids), dtype=np.float32),
            )
        )
        for landmark in ids.tolist():
            self.observers[landmark] = {}
            self.first_keyframe[landmark] = keyframe_id
            self.visible[landmark] = self.found[landmark] = 1
        self._landmarks.update(ids.tolist())
        return ids

    def observe(self, landmark: int, keyframe_id: int, feature: int) -> None:
        """Say that a keypoint of a keyframe sees a landmark; ignored if either already has another partner there."""
        ids = self.map.keyframes[keyframe_id].landmark_ids
        if ids[feature] != NO_LANDMARK or keyframe_id in self.observers[landmark]:
            return
        ids[feature] = landmark
        self.observers[landmark][keyframe_id] = feature
        self._landmarks.add(landmark)
        self._keyframes.add(keyframe_id)

    def forget_observation(self, landmark: int, keyframe_id: int) -> None:
        """Take one observation back; a landmark left with fewer than two is removed."""
        observers = self.observers.get(landmark)
        if observers is None or keyframe_id not in observers:
            return
        self.map.keyframes[keyframe_id].landmark_ids[observers.pop(keyframe_id)] = NO_LANDMARK
        self._keyframes.add(keyframe_id)
        self._landmarks.add(landmark)
        if len(observers) < 2:
            self.remove_landmarks([landmark])

    def remove_landmarks(self, landmarks: Iterable[int]) -> None:
        """Remove landmarks and all that observes them."""
        gone = [landmark for landmark in landmarks if landmark in self.observers]
        for landmark in gone:
            for keyframe_id, feature in self.observers.pop(landmark).items():
                self.map.keyframes[keyframe_id].landmark_ids[feature] = NO_LANDMARK
                self._keyframes.add(keyframe_id)
            self.first_keyframe.pop(landmark, None)
            self.visible.pop(landmark, None)
            self.found.pop(landmark, None)
        self.map.landmarks.remove(np.array(gone, dtype=np.int64))
        self._landmarks.difference_update(gone)
        self._removed.update(gone)

    def fuse(self, keep: int, drop: int) -> None:
        """Two landmarks are one: move the observations of `drop` to `keep` where `keep` has none."""
        if keep == drop or keep not in self.observers or drop not in self.observers:
            return
        moved = dict(self.observers[drop])
        visible, found = self.visible[drop], self.found[drop]
        self.remove_landmarks([drop])
        for keyframe_id, feature in moved.items():
            self.observe(keep, keyframe_id, feature)
        self.visible[keep] += visible
        self.found[keep] += found

    def move(self, keyframe_ids: IntArray, world_from_camera: FloatArray, landmark_ids: IntArray, points_world: FloatArray) -> None:
        """Set poses (K, 4, 4) and positions (L, 3), as bundle adjustment found them."""
        for keyframe_id, pose in zip(keyframe_ids.tolist(), world_from_camera, strict=True):
            self.map.keyframes[keyframe_id].world_from_camera = pose.copy()
        self._keyframes.update(keyframe_ids.tolist())
        rows = self.map.landmarks.rows(landmark_ids)
        self.map.landmarks.points_world[rows[rows >= 0]] = points_world[rows >= 0]
        self._landmarks.update(landmark_ids[rows >= 0].tolist())

    def note_moves(self, moves: Mapping[int, Similarity]) -> None:
        """A loop has moved keyframes so: tell replicas by what factor their surroundings have grown, and remember it for keyframes on their way, see `carried`."""
        self._moves.append((self.map.version + 1, dict(moves)))
        for keyframe_id, moved in moves.items():
            self._scales[keyframe_id] = self._scales.get(keyframe_id, 1.0) * moved.scale

    def carried(self, keyframe: Keyframe) -> Keyframe:
        """A keyframe to be added, moved with its reference by what tracking did not know yet when it found its pose; by nothing if it does not tell what it knew."""
        self._moves = [(version, moves) for version, moves in self._moves if version > keyframe.map_version >= 0]
        pose = Similarity(keyframe.world_from_camera)
        for _, moves in self._moves:
            pose = moves[keyframe.reference_id if keyframe.reference_id in moves else max(moves)] @ pose
        return replace(keyframe, world_from_camera=pose.rigid) if self._moves else keyframe

    def note(self, revisit: Revisit) -> None:
        """Tell with the next update that a place was seen again."""
        self._revisits.append(revisit)

    def absorb(self, other: MapEditor, self_from_other: Similarity) -> dict[int, int]:
        """Take in all of another map, whose world this one sees by `self_from_other`; its landmarks get the new ids that are returned.

        Keyframe ids must differ. The other editor is of no use afterwards. All of both maps counts as changed.
        """
        theirs = other.map.landmarks.get(other.map.landmarks.alive_ids())
        new_ids = np.arange(self._next_landmark, self._next_landmark + len(theirs), dtype=np.int64)
        self._next_landmark += len(theirs)
        renamed = dict(zip(theirs.ids.tolist(), new_ids.tolist(), strict=True))
        self.map.landmarks.put(replace(theirs, ids=new_ids, points_world=self_from_other.apply(theirs.points_world)))
        for old, new in renamed.items():
            self.observers[new] = other.observers[old]
            self.first_keyframe[new] = other.first_keyframe[old]
            self.visible[new], self.found[new] = other.visible[old], other.found[old]
        for keyframe in other.map.keyframes.values():
            seen = keyframe.landmark_ids != NO_LANDMARK
            keyframe.landmark_ids[seen] = [renamed[i] for i in keyframe.landmark_ids[seen].tolist()]
            keyframe.world_from_camera = (self_from_other @ Similarity(keyframe.world_from_camera)).rigid
            self.map.keyframes[keyframe.id] = keyframe
        self.map.covisibility.update(other.map.covisibility)
        self.touch_all()
        self._removed_keyframes.update(other._removed_keyframes)
        self._revisits.extend(other._revisits)
        return renamed

    def touch_all(self) -> None:
        """Let all of the map count as changed, as a replica that begins needs it."""
        self._new = [
            Keyframe(k.id, k.stamp_ns, k.world_from_camera, k.features, k.landmark_ids, k.reference_id, self.map.map_id) for k in self.map.keyframes.values()
        ]
        self._keyframes.update(self.map.keyframes)
        self._landmarks.update(self.map.landmarks.alive_ids().tolist())
        self._edges.update(self.map.covisibility)

    def place(self, landmark: int, point_world: FloatArray) -> None:
        """Set the position (3,) of one landmark."""
        self.map.landmarks.points_world[self.map.landmarks.rows(np.array([landmark]))] = point_world
        self._landmarks.add(landmark)

    @property
    def next_landmark(self) -> int:
        """The id that the next new landmark will get."""
        return self._next_landmark

    # ---- questions ------------------------------------------------------------------------------------------------------------------

    def carrier(self, landmark: int) -> int:
        """The keyframe that a landmark moves with: the one that saw it first, or the oldest of those that see it."""
        first = self.first_keyframe[landmark]
        return first if first in self.map.keyframes else min(self.observers[landmark])

    def observations(self, landmark_ids: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """All observations of the landmarks: index into `landmark_ids`, keyframe id, keypoint index, (M,) each, in a fixed order."""
        observed = [self.observers.get(landmark, {}) for landmark in landmark_ids.tolist()]
        index = np.repeat(np.arange(len(observed)), [len(by) for by in observed])
        keyframe_ids = np.fromiter(chain.from_iterable(observed), np.int64, len(index))
        features = np.fromiter(chain.from_iterable(by.values() for by in observed), np.int64, len(index))
        order = np.lexsort((keyframe_ids, index))
        return index[order], keyframe_ids[order], features[order]

    def shared_landmarks(self, keyframe_id: int) -> Counter[int]:
        """How many landmarks each other keyframe shares with this one."""
        shared: Counter[int] = Counter()
        ids = self.map.keyframes[keyframe_id].landmark_ids
        for landmark in ids[ids != NO_LANDMARK].tolist():
            shared.update(self.observers[landmark].keys())
        shared.pop(keyframe_id, None)
        return shared

    # ---- derived data ---------------------------------------------------------------------------------------------------------------

    def connect(self, keyframe_id: int) -> None:
        """Renew a keyframe's edges: all that share at least the threshold of landmarks, or else the best one (ORB-SLAM3)."""
        shared = self.shared_landmarks(keyframe_id)
        ordered = sorted(shared.items(), key=lambda item: (-item[1], -item[0]))
        edges = [item for item in ordered if item[1] >= self._threshold] or ordered[:1]
        covisibility = self.map.covisibility
        dropped = {other for other, _ in covisibility.get(keyframe_id, ())} - {other for other, _ in edges}
        covisibility[keyframe_id] = tuple(edges)
        self._edges.add(keyframe_id)
        for other, count in [*edges, *((other, 0) for other in dropped)]:
            theirs = [item for item in covisibility.get(other, ()) if item[0] != keyframe_id]
            if count:
                theirs.append((keyframe_id, count))
            covisibility[other] = tuple(sorted(theirs, key=lambda item: (-item[1], -item[0])))
            self._edges.add(other)

    def refresh(self) -> None:
        """Renew viewing direction, distance range, descriptor (of the newest observation) and score of every changed landmark."""
        ids = np.array(sorted(self._landmarks), dtype=np.int64)
        if len(ids) == 0:
            return
        index, keyframe_ids, features = self.observations(ids)
        seen_by, keyframe_row = np.unique(keyframe_ids, return_inverse=True)
        keyframes = [self.map.keyframes[i] for i in seen_by.tolist()]
        centers = np.stack([keyframe.center for keyframe in keyframes]) if keyframes else np.empty((0, 3))
        store = self.map.landmarks
        rows = store.rows(ids)
        rays = store.points_world[rows][index] - centers[keyframe_row]
        distance = np.linalg.norm(rays, axis=1)
        normals = np.zeros((len(ids), 3))
        np.add.at(normals, index, rays / np.maximum(distance, 1e-12)[:, None])
        depth_min, depth_max = np.full(len(ids), np.inf), np.zeros(len(ids))
        np.minimum.at(depth_min, index, distance)
        np.maximum.at(depth_max, index, distance)
        newest = np.diff(index, append=-1) != 0  # of a landmark's observations, which come by ascending keyframes
        scores = np.zeros(len(ids))
        for row, keyframe in enumerate(keyframes):
            mine = np.flatnonzero(keyframe_row == row)
            np.add.at(scores, index[mine], keyframe.features.scores[features[mine]])
            mine = mine[newest[mine]]
            store.column("descriptors")[rows[index[mine]]] = keyframe.features.descriptors[features[mine]]
        count = np.maximum(np.bincount(index, minlength=len(ids)), 1)
        store.column("normals")[rows] = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
        store.column("depth_min")[rows] = depth_min
        store.column("depth_max")[rows] = depth_max
        store.column("scores")[rows] = scores / count

    def take_update(self, absorbed: Absorbed | None = None) -> MapUpdate:
        """Everything that changed since the last call, as a message; derived data is renewed first."""
        self.refresh()
        self.map.version += 1
        ids = np.array(sorted(self._landmarks), dtype=np.int64)
        keyframes = tuple(
            KeyframeState(i, self.map.keyframes[i].world_from_camera.copy(), self.map.keyframes[i].landmark_ids.copy()) for i in sorted(self._keyframes)
        )
        update = MapUpdate(
            version=self.map.version,
            map_id=self.map.map_id,
            new_keyframes=tuple(self._new),
            keyframes=keyframes,
            landmarks=self.map.landmarks.get(ids) if len(ids) else None,
            removed_keyframes=tuple(self._removed_keyframes[i] for i in sorted(self._removed_keyframes)),
            removed_landmark_ids=np.array(sorted(self._removed), dtype=np.int64),
            covisibility={i: self.map.covisibility[i] for i in sorted(self._edges)},
            absorbed=absorbed,
            scales=dict(self._scales),
            revisits=tuple(self._revisits),
            adjusted_id=self.adjusted_id,
        )
        self.adjusted_id = -1
        self._new, self._scales, self._removed_keyframes, self._revisits = [], {}, {}, []
        for changed in (self._keyframes, self._landmarks, self._removed, self._edges):
            changed.clear()
        return update
