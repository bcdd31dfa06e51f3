"""What is made of the calibrations that camera_info brings one after the other."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

from dataclasses import replace

from stub_node import StubNode

from thegra_core.geometry.camera import CameraModel
from thegra_ros.camera_input import CameraInput
from thegra_ros.codec.images import camera_info_message
from thegra_ros.codec.stamps import header
from thegra_ros.diagnostics import Health


class Driver:
    """Tells an input what a driver publishes."""

    def __init__(self) -> None:
        self._node, self.health, self.changes = StubNode(), Health(), list[str]()
        self.input = CameraInput(self._node, "", self.health, self.changes.append)

    def tell(self, camera: CameraModel, calibrated: bool = True) -> CameraModel | None:
        """Publish a camera, or that it is not calibrated; the one in use."""
        message = camera_info_message(header(0, "thermal_camera"), camera)
        if not calibrated:
            message.k = 0.0 * message.k
        self._node.tell("camera_info", message)
        return self.input.camera


@pytest.fixture
def other(camera: CameraModel) -> CameraModel:
    return replace(camera, matrix=camera.matrix * [[1.5], [1.5], [1.0]])


def test_rectified_images_have_the_camera_of_the_projection(camera: CameraModel) -> None:
    node, health = StubNode(image_raw="/cam/image_rect"), Health()
    given = CameraInput(node, "", health, lambda _: None)
    message = camera_info_message(header(0, "thermal_camera"), camera)
    node.tell("camera_info", message)
    assert given.camera is not None and not given.camera.distortion.any()
    np.testing.assert_array_equal(given.camera.matrix, camera.matrix)
    message.p = 0.0 * message.p
    node.tell("camera_info", message)
    assert given.camera is None and "its P is zero" in health.camera_trouble


def test_another_camera_is_a_change(camera: CameraModel, other: CameraModel) -> None:
    driver = Driver()
    driver.tell(camera)
    assert driver.changes == [] and driver.tell(other).same_as(other) and len(driver.changes) == 1


def test_another_camera_after_none_is_a_change(camera: CameraModel, other: CameraModel) -> None:
    driver = Driver()
    driver.tell(camera)
    assert driver.tell(camera, calibrated=False) is None and "not calibrated" in driver.health.camera_trouble
    assert driver.tell(other).same_as(other) and driver.health.camera_trouble == ""
    (change,) = driver.changes
    assert f"{other.focal:.1f} px" in change


def test_the_same_camera_after_none_is_no_change(camera: CameraModel) -> None:
    driver = Driver()
    first = driver.tell(camera)
    driver.tell(camera, calibrated=False)
    assert driver.tell(camera) is first is not None and driver.changes == []
