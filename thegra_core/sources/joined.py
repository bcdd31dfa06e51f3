"""Recordings one after another as one: what a camera sees that is carried from place to place, or that goes its way back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.errors import InputError
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, ImageArray
from thegra_core.sources.open import camera_for, open_recording

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
TURN_STEP_DEG = 10.0
"""Roll from frame to frame of a turn that is filmed."""


@dataclass(frozen=True, slots=True)
class Clip:
    """Frames of a place, with the camera that saw them. Frame.index is the image's number in its recording."""

    name: str
    camera: CameraModel
    frames: tuple[Frame, ...]

    @property
    def period_ns(self) -> int:
        """Median time between frames; there have to be two."""
        return int(np.median(np.diff([frame.stamp_ns for frame in self.frames])))

    def backwards(self) -> Clip:
        """The way back: the same images in the opposite order, without the last one, where it begins."""
        return replace(self, frames=self.frames[-2::-1])

    def turning(self, step_deg: float = TURN_STEP_DEG) -> Clip:
        """The camera turns half round about its optical axis where the clip ends: the last image, rolled by `step_deg` more from frame to frame."""
        steps = round(180 / step_deg)
        return replace(self, frames=tuple(_rolled(self.frames[-1], self.camera, 180 * step / steps) for step in range(1, steps + 1)))

    def upside_down(self) -> Clip:
        """The same frames by a camera that is turned half round about its optical axis."""
        return replace(self, frames=tuple(_rolled(frame, self.camera, 180) for frame in self.frames))

    def seen_by(self, camera: CameraModel) -> Clip:
        """The same frames as another camera at the same places would have shown them."""
        view = View(self.camera, camera)
        return replace(self, camera=camera, frames=tuple(replace(frame, image=view(frame.image)) for frame in self.frames))


@dataclass(frozen=True, slots=True)
class Joined:
    """One recording of several clips: its frames are numbered from 0; part (N,) is the place in the list of clips, source (N,) the image's own number."""

    camera: CameraModel
    frames: tuple[Frame, ...]
    part: IntArray
    source: IntArray


def read_clip(path: Path, every: int = 1, max_frames: int | None = None) -> Clip:
    """Every `every`-th frame of a recording, at the most `max_frames` of them.

    Raises:
        InputError: If the recording cannot be read, holds less than two such frames, or nothing tells its camera.
    """
    recording = open_recording(path)
    camera = camera_for(recording)
    frames = tuple(_some(recording.frames(), every, max_frames))
    if len(frames) < 2:
        raise InputError(f"{path} holds {len(frames)} frames of those asked for; two are the least that can be joined")
    return Clip(path.resolve().name, camera, frames)


def join(clips: Sequence[Clip], gap_s: float = 0.0) -> Joined:
    """The clips as one stream at the pace of the first, all as seen by their common camera.

    Args:
        gap_s: Seconds without a frame between clips, beside the usual period.
    """
    camera = common_camera([clip.camera for clip in clips])
    mixed = len({clip.frames[0].image.dtype for clip in clips}) > 1
    period_ns, stamp_ns = clips[0].period_ns, clips[0].frames[0].stamp_ns
    frames: list[Frame] = []
    for clip in clips:
        for frame in clip.seen_by(camera).frames:
            image = frame.image.astype(np.float32) if mixed else frame.image
            frames.append(replace(frame, stamp_ns=stamp_ns, index=len(frames), image=image))
            stamp_ns += period_ns
        stamp_ns += round(gap_s * 1e9)
    part = np.repeat(np.arange(len(clips)), [len(clip.frames) for clip in clips])
    return Joined(camera, tuple(frames), part, np.array([f.index for clip in clips for f in clip.frames], np.int64))


class View:
    """Images of one camera as another one at the same place would have shown them; beyond their edge, the edge is repeated."""

    def __init__(self, own: CameraModel, other: CameraModel) -> None:
        self._where: NDArray[np.float32] | None = None
        if own.same_as(other):
            return
        width, height = other.image_size
        pixels = np.stack(np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)), axis=-1).reshape(-1, 2)
        self._where = own.distort(other.undistort(pixels)).astype(np.float32).reshape(height, width, 2)
        self._blur_px = 0.5 * float(np.sqrt(max((own.focal / other.focal) ** 2 - 1, 0.0)))  # the pixels of a coarser camera are larger

    def __call__(self, image: ImageArray) -> ImageArray:
        """The image (H, W) in the other camera's size, of the same type."""
        if self._where is None:
            return image
        smooth = cv2.GaussianBlur(image, (0, 0), self._blur_px) if self._blur_px > 0 else image
        seen: ImageArray = cv2.remap(smooth, self._where[..., 0], self._where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[assignment]
        return seen


def roll_homography(camera: CameraModel, degrees: float) -> FloatArray:
    """Pixels (3, 3), homogeneous, before to after a camera rolls about its optical axis, clockwise as it looks.

    Rays turn about the axis of the lens, so it holds with radial distortion, too; tangential distortion is taken for none.
    """
    back = np.eye(3)
    back[:2, :2] = poses.so3_exp([0.0, 0.0, -np.radians(degrees)])[:2, :2]
    return np.asarray(camera.matrix @ back @ np.linalg.inv(camera.matrix))


def _rolled(frame: Frame, camera: CameraModel, degrees: float) -> Frame:
    """What is beyond the image's edge is its mirror image."""
    turned = cv2.warpPerspective(frame.image, roll_homography(camera, degrees), camera.image_size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return replace(frame, image=turned)  # type: ignore[arg-type]


def common_camera(cameras: Sequence[CameraModel]) -> CameraModel:
    """The camera with the narrowest view, at the resolution of the coarsest: seen by it, no image is blown up, and none shows its own edge."""
    narrowest = min(cameras, key=lambda camera: camera.max_radius)
    scale = min(camera.focal for camera in cameras) / narrowest.focal
    return narrowest if scale == 1 else _resized(narrowest, scale)


def _resized(camera: CameraModel, scale: float) -> CameraModel:
    """The camera with images `scale` times as large; the pixel (0, 0) is the centre of the first one in both."""
    matrix = camera.matrix.copy()
    matrix[:2] *= scale
    matrix[:2, 2] += 0.5 * (scale - 1)
    width, height = (round(scale * size) for size in camera.image_size)
    return replace(camera, matrix=matrix, image_size=(width, height))


def _some(frames: Iterator[Frame], every: int, most: int | None) -> Iterator[Frame]:
    for number, frame in enumerate(frames):
        if most is not None and number >= most * every:
            return
        if number % every == 0:
            yield frame
