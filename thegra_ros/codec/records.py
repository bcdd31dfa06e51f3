"""The stages' records as clouds and back, equal in every bit.

A record of several tables (a keyframe with its matches, a map update) is several clouds, sent one after the other on one topic: each says which part of
how many it is, and `Assembler` puts them together. Poses are float64 columns of 16: a quaternion would round them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from thegra_core.messages import (
    Absorbed,
    Features,
    InitialMap,
    Keyframe,
    KeyframeState,
    LandmarkArrays,
    MapUpdate,
    Matches,
    RemovedKeyframe,
    Revisit,
    VisibilityCounts,
)
from thegra_ros.codec.clouds import Table, cloud_message, cloud_table

LANDMARK_COLUMNS = ("ids", "points_world", "normals", "depth_min", "depth_max", "descriptors", "scores")


def record_clouds(header: Header, kind: str, tables: list[Table]) -> list[PointCloud2]:
    """The clouds of a record."""
    return [cloud_message(header, t.columns, {"record": kind, "part": i, "parts": len(tables), **t.facts}) for i, t in enumerate(tables)]


class Assembler:
    """Puts the clouds of records together; what lacks a part is thrown away and counted."""

    def __init__(self) -> None:
        self._parts: list[Table] = []
        self.broken = 0

    def add(self, cloud: PointCloud2) -> tuple[str, list[Table]] | None:
        """The next cloud of the topic; a record's kind and tables when it was the last of them."""
        table = cloud_table(cloud)
        if int(table.facts["part"]) != len(self._parts) or (self._parts and table.facts["record"] != self._parts[0].facts["record"]):
            self.broken += 1
            self._parts = []
            if int(table.facts["part"]) != 0:
                return None
        self._parts.append(table)
        if len(self._parts) < int(table.facts["parts"]):
            return None
        parts, self._parts = self._parts, []
        return table.facts["record"], parts


def word(facts: Mapping[str, str]) -> Table:
    """A table that holds facts only."""
    return Table({"id": np.empty(0, np.int64)}, facts)


# ---- features and matches -----------------------------------------------------------------------------------------------------------


def features_table(features: Features) -> Table:
    """x, y, score, descriptor of every keypoint, and the number of its track where there are tracks."""
    width, height = features.image_size
    columns = {"x": features.keypoints[:, 0], "y": features.keypoints[:, 1], "score": features.scores, "descriptor": features.descriptors}
    if features.track_ids is not None:
        columns["track"] = features.track_ids
    return Table(columns, {"stamp_ns": str(features.stamp_ns), "extractor": features.extractor, "image_size": f"{width}x{height}", "turns": str(features.turns)})


def table_features(table: Table) -> Features:
    """The inverse of `features_table`."""
    columns = table.columns
    width, height = table.facts["image_size"].split("x")
    keypoints = np.stack([columns["x"], columns["y"]], axis=1)
    return Features(
        int(table.facts["stamp_ns"]), keypoints, columns["score"], columns["descriptor"], (int(width), int(height)), table.facts["extractor"],
        _ids(table, "track") if "track" in columns else None, int(table.facts["turns"]),
    )  # fmt: skip


def matches_table(matches: Matches) -> Table:
    """query, reference, confidence of every match."""
    columns = {"query": matches.indices[:, 0], "reference": matches.indices[:, 1], "confidence": matches.confidence}
    return Table(columns, {"stamp_ns": str(matches.stamp_ns), "reference_stamp_ns": str(matches.reference_stamp_ns)})


def table_matches(table: Table) -> Matches:
    """The inverse of `matches_table`."""
    columns, facts = table.columns, table.facts
    return Matches(int(facts["stamp_ns"]), int(facts["reference_stamp_ns"]), np.stack([columns["query"], columns["reference"]], axis=1), columns["confidence"])


# ---- keyframes ----------------------------------------------------------------------------------------------------------------------


def keyframe_tables(keyframe: Keyframe) -> list[Table]:
    """Features with landmark ids, the pose, and the matches and visibility counts there are."""
    features = features_table(keyframe.features)
    facts = {"keyframe": str(keyframe.id), "keyframe_stamp_ns": str(keyframe.stamp_ns), "reference": str(keyframe.reference_id), "map": str(keyframe.map_id), "map_version": str(keyframe.map_version)}
    tables = [Table({**features.columns, "landmark_id": keyframe.landmark_ids}, {**features.facts, **facts}), _pose_table({keyframe.id: keyframe.world_from_camera})]
    if keyframe.reference_matches is not None:
        tables.append(matches_table(keyframe.reference_matches))
    if keyframe.seen is not None:
        tables.append(Table({"landmark_id": keyframe.seen.landmark_ids, "visible": keyframe.seen.visible, "found": keyframe.seen.found}, {"seen": "1"}))
    return tables


def tables_keyframes(tables: list[Table]) -> list[Keyframe]:
    """The keyframes that follow each other in tables."""
    keyframes: list[Keyframe] = []
    for table in tables:
        facts = table.facts
        if "keyframe" in facts:
            keyframes.append(
                Keyframe(int(facts["keyframe"]), int(facts["keyframe_stamp_ns"]), np.eye(4), table_features(table), _ids(table, "landmark_id"), int(facts["reference"]), int(facts["map"]), map_version=int(facts["map_version"]))
            )
        elif "poses" in facts:
            keyframes[-1] = replace(keyframes[-1], world_from_camera=_poses(table)[keyframes[-1].id])
        elif "reference_stamp_ns" in facts:
            keyframes[-1] = replace(keyframes[-1], reference_matches=table_matches(table))
        elif "seen" in facts:
            keyframes[-1] = replace(keyframes[-1], seen=VisibilityCounts(_ids(table, "landmark_id"), _ids(table, "visible"), _ids(table, "found")))
    return keyframes


def initial_map_tables(initial: InitialMap) -> list[Table]:
    """Points, then keyframes."""
    x, y, z = initial.points_world.T
    return [Table({"x": x, "y": y, "z": z}, {"map": str(initial.map_id)}), *(t for k in initial.keyframes for t in keyframe_tables(k))]


def tables_initial_map(tables: list[Table]) -> InitialMap:
    """The inverse of `initial_map_tables`."""
    points, *rest = tables
    return InitialMap(int(points.facts["map"]), tuple(tables_keyframes(rest)), np.stack([points.columns[axis] for axis in "xyz"], axis=1))


# ---- map updates --------------------------------------------------------------------------------------------------------------------


def update_tables(update: MapUpdate) -> list[Table]:
    """Poses and landmark ids of changed keyframes, landmarks, what was removed, who sees the same, and new keyframes."""
    facts = {"update": str(update.version), "map": str(update.map_id), "revisits": json.dumps([asdict(revisit) for revisit in update.revisits]), "adjusted": str(update.adjusted_id)}
    if update.absorbed is not None:
        facts["absorbed"] = str(update.absorbed.map_id)
        facts["old_from_absorbed"] = " ".join(repr(x) for x in [*update.absorbed.rigid.ravel().tolist(), update.absorbed.scale])
    tables = [Table(_pose_table({k.id: k.world_from_camera for k in update.keyframes}).columns, facts), *_ragged("keyframe_landmarks", {k.id: k.landmark_ids for k in update.keyframes})]
    if update.landmarks is not None:
        tables.append(Table({name: getattr(update.landmarks, name) for name in LANDMARK_COLUMNS}, {"landmarks": "1"}))
    tables.append(_removed_table(update.removed_keyframes))
    tables.append(Table({"id": update.removed_landmark_ids}, {"removed_landmarks": "1"}))
    tables += _ragged("covisibility", {i: np.array(pairs, dtype=np.int64).reshape(-1, 2) for i, pairs in update.covisibility.items()}, 2)
    tables.append(Table({"id": np.array(list(update.scales), dtype=np.int64), "scale": np.array(list(update.scales.values()), dtype=np.float64)}, {"scales": "1"}))
    return [*tables, *(t for k in update.new_keyframes for t in keyframe_tables(k))]


def tables_update(tables: list[Table]) -> MapUpdate:
    """The inverse of `update_tables`."""
    named = {next(iter(_subject(t)), ""): t for t in tables}
    head, facts = tables[0], tables[0].facts
    ids = _split(named["keyframe_landmarks"])
    scales = named["scales"]
    landmarks = named.get("landmarks")
    return MapUpdate(
        version=int(facts["update"]),
        map_id=int(facts["map"]),
        new_keyframes=tuple(tables_keyframes(tables[_first_keyframe(tables) :])),
        keyframes=tuple(KeyframeState(i, pose, ids[i]) for i, pose in _poses(head).items()),
        removed_keyframes=_removed(named["removed_keyframes"]),
        landmarks=LandmarkArrays(**{n: _ids(landmarks, n) if n == "ids" else landmarks.columns[n] for n in LANDMARK_COLUMNS}) if landmarks is not None else None,
        removed_landmark_ids=_ids(named["removed_landmarks"], "id"),
        covisibility={i: tuple((int(a), int(b)) for a, b in pairs.tolist()) for i, pairs in _split(named["covisibility"]).items()},
        absorbed=_absorbed(facts),
        scales=dict(zip(_ids(scales, "id").tolist(), scales.columns["scale"].tolist(), strict=True)),
        revisits=tuple(Revisit(**revisit) for revisit in json.loads(facts["revisits"])),
        adjusted_id=int(facts["adjusted"]),
    )


def _removed_table(removed: Sequence[RemovedKeyframe]) -> Table:
    columns = {name: np.array([getattr(r, name) for r in removed], dtype=np.int64) for name in ("id", "heir_id")}
    poses = np.array([r.heir_from_removed.ravel() for r in removed], dtype=np.float64).reshape(-1, 16)
    return Table({**columns, "pose": poses}, {"removed_keyframes": json.dumps([r.stamp_ns for r in removed])})


def _removed(table: Table) -> tuple[RemovedKeyframe, ...]:
    ids, heirs, stamps = _ids(table, "id").tolist(), _ids(table, "heir_id").tolist(), json.loads(table.facts["removed_keyframes"])
    return tuple(RemovedKeyframe(*each) for each in zip(ids, stamps, heirs, table.columns["pose"].reshape(-1, 4, 4), strict=True))


def _absorbed(facts: Mapping[str, str]) -> Absorbed | None:
    if "absorbed" not in facts:
        return None
    *rigid, scale = (float(x) for x in facts["old_from_absorbed"].split())
    return Absorbed(int(facts["absorbed"]), np.array(rigid).reshape(4, 4), scale)


# ---- pieces -------------------------------------------------------------------------------------------------------------------------

_SUBJECTS = ("update", "keyframe_landmarks", "landmarks", "removed_keyframes", "removed_landmarks", "covisibility", "scales")


def _subject(table: Table) -> Iterator[str]:
    return (name for name in _SUBJECTS if name in table.facts)


def _first_keyframe(tables: list[Table]) -> int:
    return next((i for i, table in enumerate(tables) if "keyframe" in table.facts), len(tables))


def _pose_table(poses: Mapping[int, NDArray[np.float64]]) -> Table:
    matrices = np.array([pose.ravel() for pose in poses.values()], dtype=np.float64).reshape(-1, 16)
    return Table({"id": np.array(list(poses), dtype=np.int64), "pose": matrices}, {"poses": "1"})


def _poses(table: Table) -> dict[int, NDArray[np.float64]]:
    return dict(zip(_ids(table, "id").tolist(), table.columns["pose"].reshape(-1, 4, 4), strict=True))


def _ragged(subject: str, rows: Mapping[int, NDArray[np.int64]], width: int = 1) -> list[Table]:
    """Arrays of different lengths under one another; the fact tells key and length of each."""
    stacked = np.concatenate([values.reshape(-1, width) for values in rows.values()]) if rows else np.empty((0, width), np.int64)
    counts = " ".join(f"{key}:{len(values)}" for key, values in rows.items())
    return [Table({f"value{i}": stacked[:, i] for i in range(width)}, {subject: counts or "-"})]


def _split(table: Table) -> dict[int, NDArray[np.int64]]:
    subject = next(_subject(table))
    stacked = np.stack([_ids(table, name) for name in table.columns], axis=1)
    result, begin = {}, 0
    for text in table.facts[subject].split() if table.facts[subject] != "-" else ():
        key, count = (int(part) for part in text.split(":"))
        rows = stacked[begin : begin + count]
        result[key] = rows[:, 0].copy() if rows.shape[1] == 1 else rows.copy()
        begin += count
    return result


def _ids(table: Table, name: str) -> NDArray[Any]:
    return table.columns[name].astype(np.int64)
