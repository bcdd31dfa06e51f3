"""Images as frames: decoded, counted, and watched for a stream that begins anew."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from sensor_msgs.msg import CompressedImage, Image

from thegra_core.messages import Frame
from thegra_core.sources.image_decoding import DecodeError
from thegra_ros.codec.images import frame_from_image
from thegra_ros.diagnostics import COMPLAINT_PERIOD_S, Health
from thegra_ros.elsewhere import advice
from thegra_ros.environment import PROFILES_VARIABLE, config_file, profile_is_set
from thegra_ros.gap_watch import GapWatch
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.qos import SENSOR
from thegra_ros.stamp_watch import LEAST_JUMP_NS, StampWatch

MUCH_MISSING = 0.25
"""Share of images; by default Fast DDS loses 28 to 62 % of 640x512 images of 16 bit (measured)."""


class ImageInput:
    """Calls `on_frame` with each frame and its frame_id while the node is active, and `on_restart` with the reason when time goes back."""

    def __init__(self, node: ManagedNode, transport: str, health: Health, on_frame: Callable[[Frame, str], None], on_restart: Callable[[str], None]) -> None:
        self._node, self._health, self._on_frame, self._on_restart = node, health, on_frame, on_restart
        self._stamps, self._gaps, self._index = StampWatch(), GapWatch(), 0
        raw = transport == "raw"
        self._kind, name = (Image, "image_raw") if raw else (CompressedImage, "image_raw/compressed")
        self._topic = node.resolve_topic_name(name)
        node.listen(self._kind, name, SENSOR, self._on_image)
        node.every(COMPLAINT_PERIOD_S, self._complain)
        backwards = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-LEAST_JUMP_NS), on_clock_change=False)
        self._jumps = node.get_clock().create_jump_callback(backwards, post_callback=self._on_jump)

    @property
    def topic(self) -> str:
        """Where the images come from, in full."""
        return self._topic

    def forget(self) -> None:
        """Take the next stamp as the first."""
        self._stamps.forget()

    def close(self) -> None:
        """Stop watching the clock."""
        self._jumps.unregister()

    def _on_image(self, message: Image | CompressedImage) -> None:
        if not self._node.active:
            return
        self._health.image_came()
        if self._health.paused:
            return
        try:
            frame = frame_from_image(message, self._index)
        except DecodeError as error:
            self._health.bad[str(error)] += 1
            self._node.get_logger().warning(f"image not used: {error}", throttle_duration_sec=5.0)
            return
        self._index += 1
        self._tell_loss(self._gaps.missing(frame.stamp_ns))
        if self._stamps.begins_anew(frame.stamp_ns):
            self._on_restart("the images' stamps went back, as those of a bag that loops do")
        self._on_frame(frame, message.header.frame_id)

    def _complain(self) -> None:
        if self._node.active and not self._health.images:
            self._node.get_logger().warning(f"no image yet: {advice(self._node, self._kind, self._topic, 'thegra live --image TOPIC, or remap image_raw')}")

    def _tell_loss(self, missing: float | None) -> None:
        if missing is None or missing < MUCH_MISSING or profile_is_set():
            return
        self._node.get_logger().warning(
            f"about {100 * missing:.0f} % of the images are missing. Fast DDS shares less memory between processes than an image needs, unless it is told to, "
            f"in the camera's process and in this one: export {PROFILES_VARIABLE}={config_file('fastdds.xml') or 'config/fastdds.xml'}",
            throttle_duration_sec=60.0,
        )

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.delta.nanoseconds < 0:
            self._on_restart(f"time went back by {-jump.delta.nanoseconds / 1e9:.1f} s")
