"""Frames with their keypoints and tracks, as one SVG each over a PNG of the image."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from thegra_core.messages import FloatArray, Snapshot
from thegra_core.outputs.trajectory import NS_PER_S

_MAX_FRAMES = 6
_MAX_WIDTH = 800


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame of the gallery: the image as a data URI and SVG paths in its pixels."""

    caption: str
    width: int
    height: int
    image: str
    tracked: str
    untracked: str
    tracks: str


def pictures(snapshots: Sequence[Snapshot], first_stamp_ns: int) -> list[Picture]:
    """A handful of the snapshots, evenly spread."""
    if not snapshots:
        return []
    chosen = np.unique(np.linspace(0, len(snapshots) - 1, _MAX_FRAMES).round().astype(int))
    return [_picture(snapshots[i], first_stamp_ns) for i in chosen.tolist()]


def _picture(snapshot: Snapshot, first_stamp_ns: int) -> Picture:
    height, width = snapshot.image.shape
    moved = snapshot.tracked & np.all(np.isfinite(snapshot.previous), axis=1)
    found = int(snapshot.tracked.sum())
    seconds = (snapshot.stamp_ns - first_stamp_ns) / NS_PER_S
    return Picture(
        caption=f"frame {snapshot.index} · {seconds:.2f} s · {snapshot.state.value} · {found} of {len(snapshot.keypoints)} keypoints see a landmark",
        width=width,
        height=height,
        image=_data_uri(snapshot),
        tracked=_dots(snapshot.keypoints[snapshot.tracked]),
        untracked=_dots(snapshot.keypoints[~snapshot.tracked]),
        tracks=_lines(snapshot.previous[moved], snapshot.keypoints[moved]),
    )


def _data_uri(snapshot: Snapshot) -> str:
    image = snapshot.image
    if image.shape[1] > _MAX_WIDTH:
        scale = _MAX_WIDTH / image.shape[1]
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    _, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode('ascii')}"


def _dots(points: FloatArray | np.ndarray[tuple[int, int], np.dtype[np.float32]]) -> str:
    """Path of zero-length strokes, which round caps turn into dots; shifted because SVG's pixel (0, 0) begins where ours has its centre."""
    return "".join(f"M{x + 0.5:.1f} {y + 0.5:.1f}h0" for x, y in points)


def _lines(
    begin: FloatArray | np.ndarray[tuple[int, int], np.dtype[np.float32]], end: FloatArray | np.ndarray[tuple[int, int], np.dtype[np.float32]]
) -> str:
    return "".join(f"M{a + 0.5:.1f} {b + 0.5:.1f}L{x + 0.5:.1f} {y + 0.5:.1f}" for (a, b), (x, y) in zip(begin, end, strict=True))
