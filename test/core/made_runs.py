"""Finished runs with known figures, and a recording and a system that play them: what the outputs and the command line are tested on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.geometry.poses import so3_exp
from thegra_core.messages import Frame, FrameRecord, MapSummary, Run, Snapshot, TrackingResult, TrackingState
from thegra_core.preprocessing.stage import Prepared
from thegra_core.process import Usage

PERIOD_NS = 100_000_000
BEGIN_NS = 1_700_000_000_000_000_000
SIZE = (64, 48)

_STATES = {"i": TrackingState.INITIALIZING, "t": TrackingState.TRACKING, "h": TrackingState.HOLD, "l": TrackingState.LOST, "r": TrackingState.RELOCALIZING}


def true_pose(index: int) -> np.ndarray:
    """A turning walk on a spiral: no symmetry that an alignment could hide behind."""
    angle = 0.15 * index
    pose = np.eye(4)
    pose[:3, :3] = so3_exp(np.array([0.02 * index, angle, 0.1]))
    pose[:3, 3] = [2 * np.cos(angle), 0.05 * index, (2 + 0.01 * index) * np.sin(angle)]
    return pose


def make_run(states: str = "iittttthhtttlltttttt", scale: float = 0.5, noise: float = 0.0, other_map_from: int | None = None, localized: tuple[int, ...] = (0, 1)) -> Run:
    """One letter a frame: initializing, tracking, hold, lost, relocalizing. The estimate is the truth times `scale`, plus noise."""
    rng = np.random.default_rng(3)
    frames = tuple(_record(i, _STATES[s], scale, noise, rng, other_map_from, i in localized) for i, s in enumerate(states))
    tracked = [f for f in frames if f.world_from_camera is not None and f.map_id == 0]
    keyframes = tracked[::3]
    maps = [
        MapSummary(
            map_id=0,
            keyframe_stamps_ns=np.array([f.stamp_ns for f in keyframes], np.int64),
            keyframe_poses=np.array([f.world_from_camera for f in keyframes]).reshape(-1, 4, 4),
            points_world=rng.normal(size=(50, 3)),
            point_scores=rng.uniform(0.01, 1, 50).astype(np.float32),
        )
    ]
    return Run(
        frames=frames,
        maps=tuple(maps) if tracked else (),
        main_map_id=0 if tracked else -1,
        shutter_closures_ns=((BEGIN_NS + 7 * PERIOD_NS, BEGIN_NS + 9 * PERIOD_NS),) if "h" in states else (),
        losses=states.count("tl"),
        relocalizations=states.count("lt") + states.count("rt"),
        snapshots=tuple(make_snapshot(f.index, f.result.state) for f in frames[:: max(len(frames) // 4, 1)]),
    )


def make_snapshot(index: int, state: TrackingState) -> Snapshot:
    rng = np.random.default_rng(index)
    width, height = SIZE
    keypoints = rng.uniform(1, [width - 2, height - 2], (30, 2)).astype(np.float32)
    tracked = rng.uniform(size=30) < 0.6
    previous = np.where(tracked[:, None], keypoints + rng.normal(size=(30, 2)), np.nan).astype(np.float32)
    image = rng.integers(0, 255, (height, width)).astype(np.uint8)
    return Snapshot(BEGIN_NS + index * PERIOD_NS, index, state, image, keypoints, tracked, previous)


def make_camera(size: tuple[int, int] = SIZE) -> CameraModel:
    matrix = np.array([[60.0, 0, size[0] / 2], [0, 60.0, size[1] / 2], [0, 0, 1]])
    return CameraModel(matrix, np.zeros(5), DistortionModel.PLUMB_BOB, size, "made")


@dataclass
class FakeRecording:
    """Frames of noise; raises `interrupt_at`'s KeyboardInterrupt in place of that frame."""

    path: Path
    count: int = 20
    camera: CameraModel | None = field(default_factory=make_camera)
    groundtruth: Path | None = None
    interrupt_at: int | None = None
    size: tuple[int, int] = SIZE
    name: str = "made"
    topic: str | None = None
    problems: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    @property
    def frame_count(self) -> int | None:
        return self.count

    def frames(self) -> Iterator[Frame]:
        rng = np.random.default_rng(0)
        for index in range(self.count):
            if index == self.interrupt_at:
                raise KeyboardInterrupt
            yield Frame(BEGIN_NS + index * PERIOD_NS, index, rng.integers(0, 255, self.size[::-1]).astype(np.uint8))


class FakeSystem:
    """Answers each frame from a made run."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self.processed = 0
        self.warm = self.closed = False

    def warm_up(self) -> None:
        self.warm = True

    def usage(self) -> Usage:
        return Usage()

    def close(self) -> None:
        self.closed = True

    def prepare(self, frame: Frame) -> Prepared:
        return Prepared(frame)

    def track(self, prepared: Prepared) -> TrackingResult:
        self.processed += 1
        return self._run.frames[prepared.frame.index].result

    def snapshot(self) -> Snapshot | None:
        return self._run.snapshots[0]

    def current_map(self) -> MapSummary:
        return self._run.maps[0]

    def map_size(self) -> tuple[int, int]:
        return len(self._run.maps[0].keyframe_poses), len(self._run.maps[0].points_world)

    def finish(self, progress: Any = None) -> Run:
        frames = self._run.frames[: self.processed]
        return Run(frames, self._run.maps, self._run.main_map_id, self._run.shutter_closures_ns, snapshots=self._run.snapshots)


def _record(
    index: int, state: TrackingState, scale: float, noise: float, rng: np.random.Generator, other_map_from: int | None, localized: bool
) -> FrameRecord:
    stamp = BEGIN_NS + index * PERIOD_NS
    pose = true_pose(index)
    pose[:3, 3] = scale * pose[:3, 3] + rng.normal(0, noise, 3)
    live = pose.copy()
    live[:3, 3] += rng.normal(0, 2 * noise, 3)
    map_id = 1 if other_map_from is not None and index >= other_map_from else 0
    has_pose = state in (TrackingState.TRACKING, TrackingState.HOLD)
    afterwards = localized and state is TrackingState.INITIALIZING
    result = TrackingResult(
        stamp_ns=stamp,
        state=state,
        world_from_camera=live if has_pose else None,
        keypoints=500 + index,
        matches=300 + index if state is not TrackingState.LOST else 3,
        inliers=200 + index if state is TrackingState.TRACKING else 0,
        visible=400 if state is TrackingState.TRACKING else 0,
        is_keyframe=state is TrackingState.TRACKING and index % 3 == 0,
        map_id=map_id,
        reason="the camera has not moved enough: median parallax 0.2 deg of 1" if state is TrackingState.INITIALIZING else "",
        stage_ms={"preprocessing": 40.0, "features": 100.0 + index, "tracking": 20.0},
    )
    final = pose if state is TrackingState.TRACKING or afterwards else None
    return FrameRecord(index, result, final, map_id if final is not None else -1, afterwards)
