"""Image messages and files to single-channel arrays of native byte order, without a change of values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import ImageArray

MAX_NOT_FINITE = 0.1
"""Share of NaN or infinite pixels above which a float image is refused; fewer are set to the image's median."""

_DTYPES: dict[str, np.dtype[Any]] = {"8": np.dtype(np.uint8), "16U": np.dtype(np.uint16), "16S": np.dtype(np.int16), "32F": np.dtype(np.float32)}
_RAW = {
    "mono8": ("8", 1), "8uc1": ("8", 1), "8uc3": ("8", 3), "8uc4": ("8", 4), "rgb8": ("8", 3), "bgr8": ("8", 3), "rgba8": ("8", 4), "bgra8": ("8", 4),
    "mono16": ("16U", 1), "16uc1": ("16U", 1), "16sc1": ("16S", 1), "rgb16": ("16U", 3), "bgr16": ("16U", 3), "32fc1": ("32F", 1),
    "yuv422": ("8", 2), "uyvy": ("8", 2), "yuv422_yuy2": ("8", 2), "yuyv": ("8", 2),
}  # fmt: skip
_RGB_ORDER = {"rgb8", "rgba8", "rgb16"}
_UYVY = {"yuv422", "uyvy"}


class DecodeError(ValueError):
    """An image cannot be used; the message is a short reason that can be counted."""


def decode_raw(data: NDArray[np.uint8] | bytes, height: int, width: int, encoding: str, step: int = 0, big_endian: bool = False) -> ImageArray:
    """sensor_msgs/Image to (H, W) uint8, uint16 or float32.

    Colour becomes BT.601 luma; 16SC1 is shifted by 32768 to uint16, which keeps the order of values; `step` is the row length in bytes, 0: packed.

    Raises:
        DecodeError: If the encoding is unknown, the data are too short, the image is empty, or over 10 % of a float image is not finite.
    """
    kind, channels = _layout(encoding)
    if height <= 0 or width <= 0:
        raise DecodeError("image of zero size")
    dtype = _DTYPES[kind]
    row = width * channels * dtype.itemsize
    step = step or row
    buffer = np.frombuffer(data, dtype=np.uint8)
    if step < row or buffer.size < step * (height - 1) + row:
        raise DecodeError("image data shorter than its header says")
    rows = np.lib.stride_tricks.as_strided(buffer, (height, row), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(dtype.newbyteorder(">" if big_endian else "<")).reshape(height, width, channels)
    return _single_channel(pixels.astype(dtype, copy=False), encoding.lower())


def decode_compressed(data: NDArray[np.uint8] | bytes, encoding: str = "") -> ImageArray:
    """PNG, JPEG, TIFF ... to (H, W) uint8, uint16 or float32; `encoding` is what the message says the pixels are, if it does.

    Raises:
        DecodeError: If the data are no image, are cut short, or hold something other than 1, 3 or 4 channels of 8 or 16 bit or float.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    if is_truncated(buffer):
        raise DecodeError("compressed image cut short")
    try:
        image = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED) if buffer.size else None
    except cv2.error as error:
        raise DecodeError("compressed image cannot be decoded") from error
    if image is None or image.size == 0:
        raise DecodeError("compressed image cannot be decoded")
    if encoding.lower() == "16sc1" and image.dtype == np.uint16:
        image = image.view(np.int16)
    return from_array(image)


def from_array(image: NDArray[np.generic]) -> ImageArray:
    """(H, W) or (H, W, 3 | 4) in OpenCV's channel order to (H, W) uint8, uint16 or float32.

    Raises:
        DecodeError: If the type or the number of channels is another, or a float image is not finite.
    """
    channels = 1 if image.ndim == 2 else image.shape[2]
    if image.size == 0:
        raise DecodeError("image of zero size")
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    if image.dtype not in _DTYPES.values() or channels not in (1, 3, 4) or (channels > 1 and image.dtype == np.int16):
        raise DecodeError(f"image with {channels} channels of {image.dtype}")
    return _single_channel(image.reshape(*image.shape[:2], channels), "bgr")


def is_truncated(buffer: NDArray[np.uint8]) -> bool:
    """Whether a PNG lacks its end chunk; OpenCV would give such an image a black lower part without a word."""
    return buffer[:4].tobytes() == b"\x89PNG" and b"IEND" not in buffer[-64:].tobytes()


def _layout(encoding: str) -> tuple[str, int]:
    try:
        return _RAW[encoding.lower()]
    except KeyError:
        raise DecodeError(f"unknown encoding {encoding!r}") from None


def _single_channel(pixels: NDArray[np.generic], encoding: str) -> ImageArray:
    channels = pixels.shape[2]
    if channels == 2:
        return np.ascontiguousarray(pixels[:, :, 1 if encoding in _UYVY else 0]).astype(np.uint8, copy=False)
    if channels >= 3:
        return _luma(pixels, rgb=encoding in _RGB_ORDER)
    plane = np.ascontiguousarray(pixels[:, :, 0])
    convert = _CONVERT.get(plane.dtype)
    return convert(plane) if convert else plane.view(np.uint8)


def _luma(pixels: NDArray[np.generic], rgb: bool) -> ImageArray:
    code = {(3, False): cv2.COLOR_BGR2GRAY, (3, True): cv2.COLOR_RGB2GRAY, (4, False): cv2.COLOR_BGRA2GRAY, (4, True): cv2.COLOR_RGBA2GRAY}
    gray: NDArray[Any] = cv2.cvtColor(np.ascontiguousarray(pixels), code[pixels.shape[2], rgb])
    return _finite(gray) if gray.dtype == np.float32 else gray


def _finite(plane: NDArray[np.generic]) -> NDArray[np.float32]:
    image = plane.astype(np.float32, copy=False)
    bad = ~np.isfinite(image)
    count = int(np.count_nonzero(bad))
    if count > MAX_NOT_FINITE * image.size:
        raise DecodeError("float image with more than 10 % NaN or infinite pixels")
    if count:
        image = image.copy()
        image[bad] = np.median(image[~bad])
    return image


_CONVERT: dict[np.dtype[np.generic], Callable[[NDArray[np.generic]], ImageArray]] = {
    np.dtype(np.int16): lambda plane: plane.view(np.uint16) ^ np.uint16(0x8000),
    np.dtype(np.uint16): lambda plane: plane.view(np.uint16),
    np.dtype(np.float32): _finite,
}
