"""Images and camera calibrations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, ImageArray
from thegra_core.sources.image_decoding import decode_compressed, decode_raw
from thegra_ros.codec.stamps import stamp_ns

ENCODINGS: dict[tuple[str, int], str] = {("uint8", 1): "mono8", ("uint16", 1): "mono16", ("float32", 1): "32FC1", ("uint8", 3): "bgr8"}
"""(type, channels) of an array to the encoding its message names."""


def image_message(header: Header, image: NDArray[Any]) -> Image:
    """(H, W) uint8, uint16 or float32, or (H, W, 3) uint8 in the order blue, green, red, as a message.

    Raises:
        ValueError: If the array is another.
    """
    channels = 1 if image.ndim == 2 else image.shape[2] if image.ndim == 3 else 0
    encoding = ENCODINGS.get((image.dtype.name, channels))
    if encoding is None:
        raise ValueError(f"an array {image.shape} of {image.dtype} is no image that has an encoding")
    pixels = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("<"))
    message = Image(header=header, height=image.shape[0], width=image.shape[1], encoding=encoding, step=image.shape[1] * channels * image.itemsize)
    if pixels.size:  # a view of bytes cannot be cast from an empty array
        message.data.frombytes(memoryview(pixels).cast("B"))  # thousands of times faster than assigning an array
    return message


def frame_from_image(message: Image | CompressedImage, index: int) -> Frame:
    """A frame of an image message; the pixels of a raw image may share its memory.

    Raises:
        DecodeError: If the encoding is unknown or the data do not fit the header; the message is a reason that can be counted.
    """
    return Frame(stamp_ns(message), index, _pixels(message))


def camera_info_message(header: Header, camera: CameraModel) -> CameraInfo:
    """A camera as a message; the inverse is `thegra_core.sources.calibration.camera_from_info`."""
    width, height = camera.image_size
    matrix = camera.matrix
    projection = np.zeros((3, 4))
    projection[:, :3] = matrix
    return CameraInfo(
        header=header, height=height, width=width, distortion_model=camera.model.value, d=camera.distortion.tolist(), k=matrix.ravel(), r=np.eye(3).ravel(), p=projection.ravel()
    )


def _pixels(message: Image | CompressedImage) -> ImageArray:
    if isinstance(message, Image):
        return decode_raw(message.data, message.height, message.width, message.encoding, message.step, bool(message.is_bigendian))
    return decode_compressed(message.data, message.format.split(";")[0].strip())
