"""Image messages to arrays."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from thegra_core.sources.image_decoding import DecodeError, decode_compressed, decode_raw, from_array

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)


def raw(array, encoding, pad=0, big=False):
    if big:
        array = array.byteswap()
    rows = array.reshape(array.shape[0], -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=77)
    return decode_raw(rows.tobytes(), array.shape[0], array.shape[1], encoding, rows.shape[1], big)


@given(hnp.arrays(np.uint16, SHAPES), st.sampled_from(["mono16", "16UC1"]), st.integers(0, 5), st.booleans())
def test_16_bit_survives_padding_and_byte_order(array, encoding, pad, big):
    image = raw(array, encoding, pad, big)
    assert image.dtype == np.uint16
    assert image.dtype.isnative
    np.testing.assert_array_equal(image, array)


@given(hnp.arrays(np.uint8, SHAPES), st.sampled_from(["mono8", "8UC1", "MONO8"]), st.integers(0, 5))
def test_8_bit(array, encoding, pad):
    image = raw(array, encoding, pad)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, array)


@given(hnp.arrays(np.int16, SHAPES), st.booleans())
def test_signed_16_bit_keeps_its_order(array, big):
    image = raw(array, "16SC1", 0, big)
    assert image.dtype == np.uint16
    np.testing.assert_array_equal(image.astype(int) - 32768, array)


@pytest.mark.parametrize("big", [False, True])
def test_float(big):
    array = np.array([[0.5, 300.25], [-1.0, 1e6]], np.float32)
    np.testing.assert_array_equal(raw(array, "32FC1", 0, big), array)


def test_few_bad_floats_become_the_median_and_many_are_refused():
    array = np.arange(100, dtype=np.float32).reshape(10, 10)
    array[0, 0], array[0, 1] = np.nan, np.inf
    image = raw(array, "32FC1")
    assert image[0, 0] == image[0, 1] == np.median(np.arange(2, 100))
    assert np.isnan(array[0, 0])
    array[:2] = np.nan
    with pytest.raises(DecodeError, match="NaN"):
        raw(array, "32FC1")


@pytest.mark.parametrize(("encoding", "order"), [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("8UC3", (2, 1, 0)), ("rgba8", (0, 1, 2)), ("bgra8", (2, 1, 0)), ("rgb16", (0, 1, 2))])
def test_colour_becomes_bt601_luma(encoding, order):
    dtype = np.uint16 if "16" in encoding else np.uint8
    array = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (6, 5, 4 if "a" in encoding else 3)).astype(dtype)
    red, green, blue = (array[..., i].astype(float) for i in order)
    image = raw(array, encoding, 3 * dtype().itemsize)
    assert image.dtype == dtype
    np.testing.assert_allclose(image, 0.299 * red + 0.587 * green + 0.114 * blue, atol=1.0 if dtype == np.uint8 else 4.0)


@pytest.mark.parametrize(("encoding", "channel"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_yuv_takes_its_luma(encoding, channel):
    array = np.random.default_rng(0).integers(0, 255, (4, 6, 2)).astype(np.uint8)
    np.testing.assert_array_equal(raw(array, encoding), array[..., channel])


@pytest.mark.parametrize(
    ("height", "width", "encoding", "step", "reason"),
    [(4, 4, "mono16", 8, "shorter"), (4, 4, "mono8", 2, "shorter"), (0, 4, "mono8", 4, "zero size"), (2, 0, "mono8", 0, "zero size"), (2, 2, "bayer_rggb8", 2, "unknown encoding 'bayer_rggb8'")],
)
def test_bad_messages(height, width, encoding, step, reason):
    with pytest.raises(DecodeError, match=reason):
        decode_raw(bytes(16), height, width, encoding, step)


def test_last_row_may_lack_its_padding():
    assert decode_raw(bytes(range(11)), 2, 3, "mono8", 8).tolist() == [[0, 1, 2], [8, 9, 10]]


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_lossless_files(suffix, dtype):
    array = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (7, 5)).astype(dtype)
    image = decode_compressed(cv2.imencode(suffix, array)[1].tobytes())
    assert image.dtype == dtype
    np.testing.assert_array_equal(image, array)


def test_compressed_signed_keeps_its_order():
    array = np.array([[-5, 0, 7]], np.int16)
    image = decode_compressed(cv2.imencode(".png", array.view(np.uint16))[1], "16SC1")
    np.testing.assert_array_equal(image.astype(int) - 32768, array)


def test_float_tiff():
    array = np.linspace(280, 320, 30, dtype=np.float32).reshape(5, 6)
    np.testing.assert_array_equal(decode_compressed(cv2.imencode(".tiff", array)[1]), array)


@pytest.mark.parametrize(("suffix", "keep"), [(".png", 0), (".png", 3), (".png", 60), (".png", -8), (".jpg", 0), (".jpg", 3), (".jpg", 60)])
def test_cut_files_are_refused(suffix, keep):
    array = np.random.default_rng(0).integers(0, 255, (50, 50)).astype(np.uint8)
    data = cv2.imencode(suffix, array)[1].tobytes()[:keep]
    with pytest.raises(DecodeError):
        decode_compressed(data)


@pytest.mark.parametrize("array", [np.zeros((2, 2), np.int32), np.zeros((2, 2, 2), np.uint8), np.zeros((0, 3), np.uint8), np.zeros((2, 2, 3), np.int16)])
def test_other_arrays_are_refused(array):
    with pytest.raises(DecodeError):
        from_array(array)
