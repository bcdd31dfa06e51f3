"""Where the camera's calibration comes from: a file, or camera_info; and what is said while there is none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sensor_msgs.msg import CameraInfo

from thegra_core.errors import CalibrationError
from thegra_core.geometry.camera import CameraModel
from thegra_core.sources.calibration import camera_from_info, is_rectified, load_camera
from thegra_ros.diagnostics import COMPLAINT_PERIOD_S, Health
from thegra_ros.elsewhere import advice
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.qos import SENSOR


class CameraInput:
    """Holds the camera model, None while there is no usable one; `on_change` is called with the reason when another one comes than was last used.

    One that comes again, after a word that cannot be used, is the same object as before. Of images whose topic says that they are rectified it is that of the
    matrix P.

    Raises:
        CalibrationError: If the file cannot be used.
    """

    def __init__(self, node: ManagedNode, file: str, health: Health, on_change: Callable[[str], None]) -> None:
        self._node, self._health = node, health
        self._on_change = on_change
        self._seen: tuple[object, ...] | None = None
        self._last: CameraModel | None = None
        self._topic = node.resolve_topic_name("camera_info")
        self._rectified = is_rectified(node.resolve_topic_name("image_raw"))
        self.camera: CameraModel | None = load_camera(Path(file).expanduser()) if file else None
        self._health.camera_trouble = "" if self.camera else f"no camera_info on {self._topic} yet: remap camera_info to your driver's topic, or give the parameter camera_file"
        if self.camera is None:
            node.listen(CameraInfo, "camera_info", SENSOR, self._on_info)
        node.every(COMPLAINT_PERIOD_S, self._complain)

    @property
    def described(self) -> str:
        """The camera in words, for the diagnostics."""
        return described(self.camera)

    def _on_info(self, info: CameraInfo) -> None:
        seen = (tuple(info.k), tuple(info.d), info.distortion_model, info.width, info.height, tuple(info.p))
        if seen == self._seen:
            return
        self._seen = seen
        try:
            camera, zero = camera_from_info(info, self._rectified), "P" if self._rectified else "K"
            self._health.camera_trouble = "" if camera else f"{self._topic} says that the camera is not calibrated (its {zero} is zero): calibrate it, and give the parameter camera_file"
        except CalibrationError as error:
            camera, self._health.camera_trouble = None, f"{self._topic} cannot be used: {error}"
        last = self._last
        self.camera = last if camera is not None and last is not None and camera.same_as(last) else camera
        if self.camera is None:
            return
        self._last = self.camera
        what = f"camera {described(self.camera)}, from {self._topic}"
        if last is not None and self.camera is not last:
            self._on_change(f"another {what}")
        else:
            self._node.get_logger().info(what)

    def _complain(self) -> None:
        if not self._health.camera_trouble or not self._node.active:
            return
        text = self._health.camera_trouble
        if self._seen is None:
            text = f"no camera_info yet: {advice(self._node, CameraInfo, self._topic, 'remap camera_info')}. Or give a calibration: thegra live --camera FILE, parameter camera_file"
        self._node.get_logger().warning(text)


def described(camera: CameraModel | None) -> str:
    """A camera in words."""
    return "unknown" if camera is None else f"{camera.image_size[0]}x{camera.image_size[1]}, {camera.model.value}, focal length {camera.focal:.1f} px"
