"""What the four stages say to each other: small frozen records of numpy arrays, with no behaviour of their own.

Poses are 4x4 float64 `world_from_camera`; the camera frame is optical (x right, y down, z forward, REP 103).
Pixels are (x, y) with (0, 0) at the centre of the top-left pixel. Time is `stamp_ns`, the message header's stamp.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, unique

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
BoolArray = NDArray[np.bool_]
ImageArray = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]

NO_LANDMARK = -1
"""Value in `landmark_ids` of a keypoint that sees no landmark."""
UNFOLLOWED = -1
"""Value in `track_ids` of a keypoint that is not followed."""


@unique
class TrackingState(Enum):
    """What tracking knows about the pose of a frame."""

    WAITING = "waiting"  # no camera model yet
    INITIALIZING = "initializing"
    TRACKING = "tracking"
    HOLD = "hold"  # shutter closed: the pose is predicted and marked as such
    LOST = "lost"
    RELOCALIZING = "relocalizing"


@unique
class Shutter(Enum):
    """State of the camera's flat-field shutter."""

    OPEN = "open"
    CLOSED = "closed"
    JUST_OPENED = "just_opened"


@dataclass(frozen=True, slots=True)
class Frame:
    """One image of the stream: (H, W) uint8, uint16 or float32, single channel, native byte order.

    shutter_closed is what the camera itself says of its shutter; None where it says nothing.
    """

    stamp_ns: int
    index: int
    image: ImageArray
    shutter_closed: bool | None = None


@dataclass(frozen=True, slots=True)
class ShutterState:
    """Whether the camera can see at `stamp_ns`, and how that was found out.

    recalibrated: this is the first image since the shutter set level and fixed pattern anew, whether or not it hid anything.
    """

    stamp_ns: int
    shutter: Shutter
    reason: str = ""
    recalibrated: bool = False


@dataclass(frozen=True, slots=True)
class Features:
    """Keypoints of one frame.

    keypoints (N, 2) float32 pixels of the raw (distorted) image; scores (N,) float32 in (0, 1];
    descriptors (N, D) float32 of unit norm, or (N, D) uint8 binary; image_size (width, height). track_ids (N,) int64, where keypoints are followed
    from image to image: those of the same number are the same point, and those of `UNFOLLOWED` are not followed; None where none are. `turns` are the quarter turns counter-clockwise by which the
    image was turned when they were found and described; keypoints and size are those of the upright image all the same.
    """

    stamp_ns: int
    keypoints: Float32Array
    scores: Float32Array
    descriptors: NDArray[np.float32] | NDArray[np.uint8]
    image_size: tuple[int, int]
    extractor: str
    track_ids: IntArray | None = None
    turns: int = 0

    def __len__(self) -> int:
        return len(self.keypoints)

    def chosen(self, rows: IntArray) -> Features:
        """The keypoints of `rows` (M,) alone."""
        ids = self.track_ids[rows] if self.track_ids is not None else None
        return replace(self, keypoints=self.keypoints[rows], scores=self.scores[rows], descriptors=self.descriptors[rows], track_ids=ids)


@dataclass(frozen=True, slots=True)
class Matches:
    """Correspondences of a query frame with a reference frame.

    indices (M, 2) int32 columns (query, reference), each keypoint at most once; confidence (M,) float32 in [0, 1].
    """

    stamp_ns: int
    reference_stamp_ns: int
    indices: Int32Array
    confidence: Float32Array

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A frame that joins the map, as tracking hands it to mapping.

    landmark_ids (N,) int64, one per keypoint, `NO_LANDMARK` where there is none. `reference_matches` are the learned
    matches to keyframe `reference_id` that tracking already has. The visibility counts are those of the frames since the last keyframe. map_version is that of the
    newest update of the map that tracking knew; -1 if it is not told.
    """

    id: int
    stamp_ns: int
    world_from_camera: FloatArray
    features: Features
    landmark_ids: IntArray
    reference_id: int
    map_id: int
    reference_matches: Matches | None = None
    seen: VisibilityCounts | None = None
    map_version: int = -1


@dataclass(frozen=True, slots=True)
class VisibilityCounts:
    """How often landmarks were predicted visible and how often they were found (paper Sec. III-C, culling). All (L,) int64."""

    landmark_ids: IntArray
    visible: IntArray
    found: IntArray


@dataclass(frozen=True, slots=True)
class InitialMap:
    """A first map as the initializer solved it; keyframes' `landmark_ids` are rows of `points_world` (P, 3)."""

    map_id: int
    keyframes: tuple[Keyframe, ...]
    points_world: FloatArray


@dataclass(frozen=True, slots=True)
class LandmarkArrays:
    """Landmarks as structure of arrays.

    ids (L,) int64; points_world (L, 3); normals (L, 3) unit mean viewing directions, from camera to point; depth_min, depth_max (L,) the
    distances at which the point was observed; descriptors (L, D); scores (L,) float32 mean detection score.
    """

    ids: IntArray
    points_world: FloatArray
    normals: FloatArray
    depth_min: FloatArray
    depth_max: FloatArray
    descriptors: NDArray[np.float32] | NDArray[np.uint8]
    scores: Float32Array

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class KeyframeState:
    """A keyframe as the map has it now: the part of it that mapping changes."""

    id: int
    world_from_camera: FloatArray
    landmark_ids: IntArray


@dataclass(frozen=True, slots=True)
class Absorbed:
    """A map that has become part of another: a point x of its world is scale * R x + t in the other's, with `rigid` (4, 4) holding R and t."""

    map_id: int
    rigid: FloatArray
    scale: float


@dataclass(frozen=True, slots=True)
class RemovedKeyframe:
    """A keyframe that left its map, and the one that stays for it: `heir_from_removed` (4, 4) carries over what was placed beside it."""

    id: int
    stamp_ns: int
    heir_id: int
    heir_from_removed: FloatArray


@dataclass(frozen=True, slots=True)
class Revisit:
    """A place seen again that changed a map: a loop within it, or another map that it took in (`absorbed_map_id`, -1 for a loop).

    Keyframe `keyframe_id` of `stamp_ns` saw by `landmarks` landmarks what `old_keyframe_id` had seen. `moved` is by how much that moved it, over the scene's
    median depth (0 for a merge, whose worlds had nothing to do with each other); `scale` old map units per new one.
    """

    stamp_ns: int
    map_id: int
    keyframe_id: int
    old_keyframe_id: int
    landmarks: int
    moved: float
    scale: float
    absorbed_map_id: int = -1

    @property
    def is_loop(self) -> bool:
        return self.absorbed_map_id < 0


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """Everything that mapping changed since the last update; applying it to a replica makes the replica equal to the map.

    `new_keyframes` carry their features; `keyframes` restate pose and landmark ids of each keyframe that changed (the new ones too);
    `landmarks` restate each landmark that is new or changed; `absorbed` names a map that this one has taken in, and the update then holds all of the map;
    `scales` tells by what factor the surroundings of keyframes grew, where a loop changed their scale; heirs of removed keyframes grow after they inherited.
    `adjusted_id` is the keyframe around which the map has been adjusted, -1 if around none.
    """

    version: int
    map_id: int
    new_keyframes: tuple[Keyframe, ...] = ()
    keyframes: tuple[KeyframeState, ...] = ()
    removed_keyframes: tuple[RemovedKeyframe, ...] = ()
    landmarks: LandmarkArrays | None = None
    removed_landmark_ids: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    covisibility: Mapping[int, tuple[tuple[int, int], ...]] = field(default_factory=dict)  # keyframe id -> ((keyframe id, shared points), ...)
    absorbed: Absorbed | None = None
    scales: Mapping[int, float] = field(default_factory=dict)
    revisits: tuple[Revisit, ...] = ()
    adjusted_id: int = -1


@dataclass(frozen=True, slots=True)
class TrackingResult:
    """What is known about one frame when its processing ends.

    world_from_camera is None unless the state is TRACKING (estimated) or HOLD (predicted); covariance (6, 6), rotation first, of a
    perturbation in the camera frame (rad, map units); twist (6,) angular then linear velocity in the camera frame (rad/s, map units/s);
    stage_ms maps a stage to milliseconds. `reason` says in words why there is no pose, or why initialisation waits.
    """

    stamp_ns: int
    state: TrackingState
    world_from_camera: FloatArray | None = None
    covariance: FloatArray | None = None
    twist: FloatArray | None = None
    keypoints: int = 0
    matches: int = 0
    inliers: int = 0
    visible: int = 0
    is_keyframe: bool = False
    map_id: int = -1
    reference_id: int = -1
    reason: str = ""
    stage_ms: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """The final account of one frame.

    world_from_camera_live is the pose as estimated at the time (causal); world_from_camera the one carried by the final map, also for
    frames localised afterwards. Both None where there is none; HOLD frames have `predicted` only.
    """

    index: int
    result: TrackingResult
    world_from_camera: FloatArray | None
    map_id: int
    localized_afterwards: bool = False

    @property
    def stamp_ns(self) -> int:
        return self.result.stamp_ns

    @property
    def world_from_camera_live(self) -> FloatArray | None:
        return self.result.world_from_camera if self.result.state is TrackingState.TRACKING else None

    @property
    def predicted(self) -> FloatArray | None:
        return self.result.world_from_camera if self.result.state is TrackingState.HOLD else None


@dataclass(frozen=True, slots=True)
class MapSummary:
    """A finished map: keyframe poses (K, 4, 4), their stamps (K,) int64, points (P, 3) and the points' scores (P,)."""

    map_id: int
    keyframe_stamps_ns: IntArray
    keyframe_poses: FloatArray
    points_world: FloatArray
    point_scores: Float32Array


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One pre-processed image with what was found in it, for reports and viewers.

    image (H, W) uint8; keypoints (N, 2) px; tracked (N,) bool, keypoints that see a landmark; previous (N, 2) px where each tracked keypoint
    was in the reference keyframe, NaN where unknown.
    """

    stamp_ns: int
    index: int
    state: TrackingState
    image: NDArray[np.uint8]
    keypoints: Float32Array
    tracked: BoolArray
    previous: Float32Array


@dataclass(frozen=True, slots=True)
class Run:
    """All that a finished run knows; `outputs` turns it into files."""

    frames: tuple[FrameRecord, ...]
    maps: tuple[MapSummary, ...]
    main_map_id: int  # -1: no map
    shutter_closures_ns: tuple[tuple[int, int], ...] = ()
    losses: int = 0
    relocalizations: int = 0
    loops: int = 0
    merges: int = 0
    revisits: tuple[Revisit, ...] = ()
    bad_frames: Mapping[str, int] = field(default_factory=dict)  # reason -> frames
    snapshots: tuple[Snapshot, ...] = ()
