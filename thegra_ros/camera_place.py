"""The frames in use: their names from the parameters and the images, the camera's place on the base from a parameter or from /tf_static."""

from __future__ import annotations

from dataclasses import replace

from thegra_core.errors import ConfigError
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.node_config import NodeConfig
from thegra_ros.tf import FixedTransforms
from thegra_ros.transforms import BODY_FROM_OPTICAL, Frames, extrinsics


class CameraPlace:
    """Holds the frames; `see` takes the images' frame_id.

    Raises:
        ConfigError: If base_from_camera is no pose, or odom_frame is given without base_frame.
    """

    def __init__(self, node: ManagedNode, own: NodeConfig) -> None:
        self._node, self._own = node, own
        self.frames = frames_of(own)
        looks_up = own.base_frame and not own.base_from_camera
        self._fixed = FixedTransforms(node) if looks_up else None

    def knows(self, frame_id: str) -> bool:
        """Whether it is told where a camera of that frame sits on the base."""
        return self._fixed is None or self._fixed.find(self._own.base_frame, frame_id) is not None

    def see(self, frame_id: str) -> None:
        """Name the camera's frame after an image, and find where it sits."""
        camera = self._own.camera_frame or frame_id or "camera"
        if camera == self.frames.camera:
            return
        self.frames = replace(self.frames, camera=camera)
        if self._fixed is None:
            return
        found = self._fixed.find(self._own.base_frame, camera)
        where = "from /tf_static" if found is not None else "nothing tells: taken to be at its origin, looking forward; give base_from_camera"
        self._node.get_logger().info(f"place of {camera} on {self._own.base_frame}: {where}")
        self.frames = replace(self.frames, base_from_camera=found if found is not None else BODY_FROM_OPTICAL)


def frames_of(own: NodeConfig) -> Frames:
    """Frame names and extrinsics that the parameters give; the camera's name comes with the first image.

    Raises:
        ConfigError: If base_from_camera is no pose, or odom_frame is given without base_frame.
    """
    if own.odom_frame and not own.base_frame:
        raise ConfigError(f"odom_frame {own.odom_frame} is given without base_frame, the frame that moves in it: give base_frame, as in base_frame:=base_link")
    try:
        placed = extrinsics(own.base_from_camera) if own.base_from_camera else BODY_FROM_OPTICAL
    except ValueError as error:
        raise ConfigError(f"base_from_camera: {error}") from error
    return Frames(own.map_frame, own.odom_frame, own.base_frame, "", placed, own.scale)
