"""Live views of a run; headless runs use one that shows nothing."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from thegra_core.errors import ConfigError
from thegra_core.messages import FloatArray, MapSummary, Run, Snapshot, TrackingResult, TrackingState

VIEWERS = ("none", "rerun")


class Scene(Protocol):
    """What a viewer may ask the running system; image and map cost time, so only viewers that draw them ask."""

    def snapshot(self) -> Snapshot | None:
        """Image and keypoints of the last frame; None if there was nothing to see."""
        ...

    def current_map(self) -> MapSummary | None:
        """A copy of the map being tracked; None before the first one."""
        ...

    def map_size(self) -> tuple[int, int]:
        """Keyframes and landmarks of the map being tracked."""
        ...


class Viewer(Protocol):
    """Shows a run while it goes on."""

    def show(self, result: TrackingResult, scene: Scene) -> None:
        """One processed frame."""
        ...

    def finish(self, run: Run) -> None:
        """The finished run, with its map."""
        ...


class NullViewer:
    """Shows nothing."""

    def show(self, result: TrackingResult, scene: Scene) -> None:
        """Nothing."""

    def finish(self, run: Run) -> None:
        """Nothing."""


class RerunViewer:
    """Image, keypoints, pose, path and counts in the Rerun viewer (https://rerun.io), or into a .rrd file.

    Raises:
        ConfigError: If the package is not installed.
    """

    def __init__(self, name: str = "thegra", save: Path | None = None) -> None:
        self._rr: Any = _import_rerun()
        self._recording = self._rr.RecordingStream(name)
        self._path: list[FloatArray] = []
        if save is not None:
            self._recording.save(str(save))
        else:
            self._recording.spawn()
        self._recording.log("world", self._rr.ViewCoordinates.RDF, static=True)

    def show(self, result: TrackingResult, scene: Scene) -> None:
        """Log the frame at its own time."""
        rr, recording = self._rr, self._recording
        recording.set_time("stamp", timestamp=np.datetime64(result.stamp_ns, "ns"))
        picture = scene.snapshot()
        if picture is not None:
            recording.log("image", rr.Image(picture.image, color_model="L"))
            colours = np.where(picture.tracked[:, None], [[64, 200, 120]], [[230, 160, 60]]).astype(np.uint8)
            recording.log("image/keypoints", rr.Points2D(picture.keypoints, colors=colours, radii=2.0))
        if result.world_from_camera is not None:
            self._show_pose(result.world_from_camera, result.state)
        current = scene.current_map() if result.is_keyframe else None
        if current is not None:
            self._show_map(current.keyframe_poses, current.points_world)
        recording.log("state", rr.TextLog(f"{result.state.value} {result.reason}".strip()))
        for name in ("keypoints", "matches", "inliers"):
            recording.log(f"counts/{name}", rr.Scalars(float(getattr(result, name))))

    def finish(self, run: Run) -> None:
        """Log the finished map's points and keyframes, and flush."""
        main = next((m for m in run.maps if m.map_id == run.main_map_id), None)
        if main is not None:
            self._show_map(main.keyframe_poses, main.points_world)
        self._recording.flush()

    def _show_map(self, keyframe_poses: FloatArray, points_world: FloatArray) -> None:
        self._recording.log("world/points", self._rr.Points3D(points_world))
        self._recording.log("world/keyframes", self._rr.LineStrips3D([keyframe_poses[:, :3, 3]]))

    def _show_pose(self, world_from_camera: FloatArray, state: TrackingState) -> None:
        rr, recording = self._rr, self._recording
        recording.log("world/camera", rr.Transform3D(translation=world_from_camera[:3, 3], mat3x3=world_from_camera[:3, :3]))
        if state is TrackingState.TRACKING:
            self._path.append(world_from_camera[:3, 3])
            recording.log("world/path", rr.LineStrips3D([np.array(self._path)]))


def make_viewer(name: str) -> Viewer:
    """Viewer by its name on the command line.

    Raises:
        ConfigError: If there is no such viewer, or its package is not installed.
    """
    if name == "none":
        return NullViewer()
    if name == "rerun":
        return RerunViewer()
    raise ConfigError(f"unknown viewer {name!r}; known: {', '.join(VIEWERS)}")


def _import_rerun() -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise ConfigError("the viewer needs Rerun, which is not installed: pip install 'rerun-sdk>=0.23' (or run without --viewer)") from error
