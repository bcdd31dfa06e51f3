"""The frames in use: their names from the parameters and the images, the camera's place on the base from a parameter or from /tf_static."""

from __future__ import annotations

from dataclasses import replace

from thegra_core.errors import ConfigError
from thegra_ros.diagnostics import COMPLAINT_PERIOD_S
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.node_config import NodeConfig
from thegra_ros.tf import FixedTransforms
from thegra_ros.transforms import BODY_FROM_OPTICAL, Frames, extrinsics


class CameraPlace:
    """Holds the frames; `see` takes the images' frame_id.

    A node that begins hears the images sooner than /tf_static, or robot_state_publisher starts after it: as long as nothing tells where the camera sits it is
    looked up again with each image.

    Raises:
        ConfigError: If base_from_camera is no pose, or odom_frame is given without base_frame.
    """

    def __init__(self, node: ManagedNode, own: NodeConfig) -> None:
        self._node, self._own = node, own
        self.frames = frames_of(own)
        looks_up = own.base_frame and not own.base_from_camera
        self._fixed = FixedTransforms(node) if looks_up else None
        self._found = False
        if self._fixed is not None:
            node.every(COMPLAINT_PERIOD_S, self._complain)

    def knows(self, frame_id: str) -> bool:
        """Whether it is told where a camera of that frame sits on the base."""
        return self._fixed is None or self._fixed.find(self._own.base_frame, frame_id) is not None

    def see(self, frame_id: str) -> None:
        """Name the camera's frame after an image, and find where it sits while that is not known."""
        camera = self._own.camera_frame or frame_id or "camera"
        if camera != self.frames.camera:
            self.frames, self._found = replace(frames_of(self._own), camera=camera), False
        if self._fixed is None or self._found:
            return
        place = self._fixed.find(self._own.base_frame, camera)
        if place is not None:
            self.frames, self._found = replace(self.frames, base_from_camera=place), True
            self._node.get_logger().info(f"place of {camera} on {self._own.base_frame}: from /tf_static")

    def _complain(self) -> None:
        if self._node.active and self.frames.camera and not self._found:
            self._node.get_logger().warning(
                f"nothing tells the place of {self.frames.camera} on {self._own.base_frame}: taken to be at its origin, looking forward. "
                f"Publish {self._own.base_frame} -> {self.frames.camera} on /tf_static, or give base_from_camera"
            )


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
