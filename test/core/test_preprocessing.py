"""Filters and chains against their definitions and against scikit-image and OpenCV."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from skimage.restoration import denoise_tv_chambolle

from thegra_core import config as cfg
from thegra_core.config import PreprocessingConfig
from thegra_core.errors import ConfigError
from thegra_core.preprocessing import filters, repair, windows
from thegra_core.preprocessing.chain import FILTERS, LIMITS, Chain
from thegra_core.preprocessing.noise import noise_sigma
from thegra_core.preprocessing.stability import SteadyWindow
from thegra_core.sources.open import open_recording

DTYPES = (np.uint8, np.uint16, np.float32)
EVERY_FILTER = tuple(section() for section in cfg.FILTER_SECTIONS)
ENDS_IN_8_BIT = tuple(section() for section in (cfg.HistogramClip, cfg.HistogramCdf, cfg.PercentileStretch))
BEFORE_8_BIT = tuple(section for section in EVERY_FILTER if section.filter not in ("kelvin_window", "clahe", "band_pass"))
"""Those that a constant offset of the counts passes through; CLAHE's bins are fixed, the band-pass takes the magnitude."""


def apply(section, image):
    return FILTERS[section.filter](image, **section.model_dump(exclude={"filter"}))


def thermal(seed=0, height=64, width=80, noise=4.0):
    """A smooth scene of about 200 counts with edges and noise, as 16-bit counts."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    scene = 3000 + 60 * np.sin(x / 9) + 40 * np.cos(y / 7) + 80 * ((x // 16 + y // 16) % 2)
    return np.clip(np.rint(scene + rng.normal(0, noise, scene.shape)), 0, 65535).astype(np.uint16)


def he_clip_as_published(image, count, fold):
    """The loops over the raw histogram, bin by bin."""
    histogram = np.bincount(image.ravel(), minlength=65536)
    total, low = 0, 1
    while total < count:
        total += histogram[low]
        low += 1
    low -= 1
    total, high = 0, 65535
    while total < count:
        total += histogram[high]
        high -= 1
    high += 1
    values = (image.astype(np.float64) - low) * (255 / (high - low))
    return np.clip(np.rint(np.abs(values) if fold else values), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("fold", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_he_clip_is_the_published_one(seed, fold):
    image = thermal(seed, 512, 640)
    image[:3, :100] = 0  # missing pixels
    expected = he_clip_as_published(image, 10000, fold)
    assert np.abs(windows.he_clip(image, fold=fold).astype(int) - expected).max() <= 1


def test_he_clip_of_floats_agrees_with_integers():
    image = thermal()
    np.testing.assert_array_equal(windows.he_clip(image.astype(np.float32)), windows.he_clip(image))


def test_he_clip_does_not_depend_on_the_scale_of_floats():
    image = thermal().astype(np.float32)
    difference = windows.he_clip(image / 16384).astype(int) - windows.he_clip(image)
    assert np.abs(difference).max() <= 1


def test_he_clip_fold_mirrors_the_coldest():
    image = np.repeat(np.arange(100, 200, dtype=np.uint16), 10).reshape(20, 50)
    clamped, folded = windows.he_clip(image, 0.1), windows.he_clip(image, 0.1, fold=True)
    assert clamped[0, 0] == 0 < folded[0, 0]
    np.testing.assert_array_equal(clamped[image >= 109], folded[image >= 109])


def test_chambolle_is_scikit_images():
    image = thermal(noise=6.0)
    expected = denoise_tv_chambolle(image.astype(np.float64), weight=4.0)
    np.testing.assert_allclose(filters.chambolle_tv(image), expected, atol=0.002)


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(0, 99), st.sampled_from([0.3, 4.0, 50.0]), st.sampled_from([1, 2, 5, 40]))
def test_chambolle_of_any_shape(height, width, seed, weight, iterations):
    image = thermal(seed, height, width).astype(np.float32)
    expected = denoise_tv_chambolle(image.astype(np.float64), weight=weight, max_num_iter=iterations)
    # a cost that lies on the stop's edge may give one step more or less
    longer = denoise_tv_chambolle(image.astype(np.float64), weight=weight, max_num_iter=iterations, eps=0)
    out = filters.chambolle_tv(image, weight, max_iterations=iterations)
    assert min(np.abs(out - expected).max(), np.abs(out - longer).max()) < 0.01


@pytest.mark.parametrize("weight", [0.5, 4.0, 20.0])
def test_chambolle_smooths_more_with_weight_and_keeps_the_mean(weight):
    image = thermal()
    smooth = filters.chambolle_tv(image, weight)
    assert smooth.dtype == np.float32
    assert smooth.mean() == pytest.approx(image.mean(), abs=0.05)
    assert np.abs(np.diff(smooth)).sum() < np.abs(np.diff(image.astype(float))).sum()


@pytest.mark.parametrize("noise", [0.5, 3.0, 20.0])
def test_noise_is_measured(noise):
    y, x = np.mgrid[:256, :320]
    image = 3000 + 200 * np.sin(x / 40) + 0.5 * y + 300.0 * (x // 64 % 2) + np.random.default_rng(1).normal(0, noise, x.shape)
    assert noise_sigma(image.astype(np.float32)) == pytest.approx(noise, rel=0.1)
    assert noise_sigma(np.rint(image).astype(np.uint16)) == pytest.approx(np.hypot(noise, 0.29), rel=0.1)  # whole counts add theirs
    assert noise_sigma(np.zeros((40, 2), np.uint16)) == 0


def test_chambolle_by_noise_does_not_depend_on_the_gain():
    image = thermal(2).astype(np.float32)
    plain = filters.chambolle_tv(image, 1.0, "noise")
    np.testing.assert_allclose(filters.chambolle_tv(7 * image, 1.0, "noise"), 7 * plain, rtol=1e-4)
    np.testing.assert_allclose(plain, filters.chambolle_tv(image, noise_sigma(image)), rtol=1e-6)


def test_he_cdf_8_bit_is_opencvs_and_16_bit_uses_the_whole_range():
    image = (thermal() // 16).astype(np.uint8)
    np.testing.assert_array_equal(filters.he_cdf(image), cv2.equalizeHist(image))
    assert np.abs(filters.he_cdf(image.astype(np.uint16)).astype(int) - cv2.equalizeHist(image)).max() <= 1
    wide = filters.he_cdf(thermal())
    assert (wide.min(), wide.max()) == (0, 255)
    assert np.abs(np.histogram(wide, 8, (0, 256))[0] / wide.size - 1 / 8).max() < 0.03


def test_clahe_is_opencvs():
    for image in ((thermal() // 16).astype(np.uint8), thermal()):
        np.testing.assert_array_equal(filters.clahe(image, 2.0, 8), cv2.createCLAHE(2.0, (8, 8)).apply(image))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [3, 5])
def test_median_inside(dtype, size):
    image = np.random.default_rng(0).integers(0, 250, (20, 20)).astype(dtype)
    windows = np.lib.stride_tricks.sliding_window_view(image, (size, size))
    r = size // 2
    np.testing.assert_array_equal(filters.median(image, size)[r:-r, r:-r], np.median(windows, axis=(2, 3)).astype(dtype))


def test_band_pass_keeps_its_ring():
    x = np.tile(np.arange(128), (128, 1))
    slow, fast = (1000 * np.cos(2 * np.pi * k * x / 128) for k in (5, 30))
    image = (slow + fast + 4000).astype(np.float32)
    np.testing.assert_allclose(filters.band_pass(image, 0, 10), slow + 4000, atol=1)
    np.testing.assert_allclose(filters.band_pass(image, 20, 40), np.abs(fast), atol=1)
    full = np.random.default_rng(0).integers(0, 255, (33, 47)).astype(np.uint8)
    np.testing.assert_array_equal(filters.band_pass(full, 0, 1000), full)


def test_band_pass_is_the_shifted_disc():
    image = thermal(height=63, width=80).astype(np.float32)
    spectrum = np.fft.fftshift(np.fft.fft2(image.astype(np.float64)))
    v, u = np.mgrid[:63, :80]
    spectrum[np.hypot(v - 31, u - 40) > 12] = 0
    np.testing.assert_allclose(filters.band_pass(image, 0, 12), np.abs(np.fft.ifft2(np.fft.ifftshift(spectrum))), atol=0.05)


def test_bilateral_is_opencvs():
    image = (thermal() // 16).astype(np.uint8)
    np.testing.assert_array_equal(filters.bilateral(image), cv2.bilateralFilter(image, 4, 35, 35))
    assert filters.bilateral(thermal()).dtype == np.float32


def test_stretch_maps_its_percentiles():
    image = np.arange(10000, dtype=np.uint16).reshape(100, 100)
    out = windows.stretch(image, 1, 99)
    assert (int(out[0, 99]), int(out[1, 0]), int(out[99, 0])) == (0, 0, 255)
    assert abs(int(out[50, 0]) - 127) <= 2


def test_kelvin_window_by_hand():
    image = np.array([[28315, 28815, 29815, 30315, 31315, 40000]], np.uint16)
    np.testing.assert_array_equal(windows.kelvin_window(image, 283.15, 303.15, 0.01), [[0, 64, 191, 255, 255, 255]])
    np.testing.assert_array_equal(windows.kelvin_window(np.array([[10.0, 30.0, 50.0]], np.float32), 283.15, 303.15, 1.0, 273.15), [[0, 255, 255]])
    with pytest.raises(ConfigError, match="must lie above"):
        cfg.load_config(overrides={"preprocessing.filters": [{"filter": "kelvin_window", "low_k": 300, "high_k": 290}]})


def test_difference_of_gaussians_is_zero_mean_and_finds_its_scale():
    y, x = np.mgrid[:64, :64]
    blob = np.exp(-((x - 32.0) ** 2 + (y - 32.0) ** 2) / (2 * 2.0**2)).astype(np.float32)
    out = filters.difference_of_gaussians(1000 * blob + 5000, 1.0, 4.0)
    # a Gaussian of sigma 2 smoothed by s has height 4 / (4 + s^2)
    assert out[32, 32] == pytest.approx(1000 * (4 / 5 - 4 / 20), rel=0.02)
    assert out[0, 0] == pytest.approx(0, abs=0.1)


# ---- repair of the sensor's faults -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1])
def test_destripe_takes_off_stripes_and_leaves_the_scene(axis):
    scene = thermal(noise=2.0, height=96, width=96).astype(np.float32)
    stripes = np.random.default_rng(1).normal(0, 12, 96).astype(np.float32)
    striped = scene + (stripes[None, :] if axis == 0 else stripes[:, None])
    out = repair.destripe(striped, columns=axis == 0, rows=axis == 1)
    assert np.sqrt(np.mean((out - scene) ** 2)) < 0.4 * stripes.std()
    untouched = repair.destripe(scene, columns=axis == 0, rows=axis == 1)
    assert np.sqrt(np.mean((untouched - scene) ** 2)) < 0.15 * stripes.std()
    np.testing.assert_array_equal(repair.destripe(scene, columns=False), scene)


def test_svd_destripe_takes_off_stripes_whose_gain_changes():
    scene = thermal(noise=2.0, height=96, width=96).astype(np.float32)
    stripes = np.random.default_rng(1).normal(0, 12, 96) * np.linspace(0.0, 2.0, 96)[:, None]
    out = repair.svd_destripe((scene + stripes).astype(np.float32))
    assert np.sqrt(np.mean((out - scene) ** 2)) < 0.7 * np.sqrt(np.mean(stripes**2))
    untouched = repair.svd_destripe(scene)
    assert np.sqrt(np.mean((untouched - scene) ** 2)) < 2.0
    assert repair.svd_destripe(thermal()).dtype == np.uint16


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_dead_pixels_are_found_and_nothing_else(dtype):
    image = thermal(noise=2.0).astype(dtype)
    truth, places = image.copy(), [(0, 0), (5, 40), (30, 79), (63, 10), (40, 40)]
    for n, (y, x) in enumerate(places):
        image[y, x] = 0 if n % 2 else 16000
    out = repair.repair_dead_pixels(image)
    changed = set(zip(*map(np.ndarray.tolist, np.nonzero(out != image)), strict=True))
    assert changed == set(places)
    assert max(abs(float(out[p]) - float(truth[p])) for p in places) < 120  # at an edge of the scene either side is right
    hot = thermal(noise=2.0)
    hot[20:22, 20:22] = 9000
    np.testing.assert_array_equal(repair.repair_dead_pixels(hot), hot, "a hot object of four pixels is no dead pixel")


# ---- properties ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("section", BEFORE_8_BIT, ids=lambda s: s.filter)
@pytest.mark.parametrize("last", ENDS_IN_8_BIT, ids=lambda s: s.filter)
def test_a_constant_offset_changes_nothing_in_the_end(section, last):
    """A shutter closure or the core's drift lifts all counts alike."""
    image = thermal(noise=3.0)
    lifted = (image + 500).astype(np.uint16)
    a, b = (apply(last, apply(section, i)).astype(int) for i in (image, lifted))
    assert np.mean(np.abs(a - b) <= 1) > 0.999


@pytest.mark.parametrize("section", [cfg.Destripe(), cfg.RepairDeadPixels(), cfg.KelvinWindow(low_k=1, high_k=3.55, kelvin_at_zero=1)], ids=lambda s: s.filter)
def test_a_second_pass_changes_little(section):
    image = (thermal(noise=1.0) - 2700).clip(0, 255).astype(np.uint8)
    once = apply(section, image)
    twice = apply(section, once)
    first, second = (np.abs(a.astype(float) - b).mean() for a, b in ((once, image), (twice, once)))
    assert second <= 0.5 * first or second < 0.6  # rounding to whole levels


@given(hnp.arrays(np.uint16, hnp.array_shapes(min_dims=2, max_dims=2, min_side=4, max_side=24)), st.sampled_from([windows.he_clip, filters.he_cdf, windows.stretch, windows.kelvin_window]))
def test_maps_to_8_bit_are_monotone(image, function):
    for values in (image, image.astype(np.float32), (image >> 8).astype(np.uint8)):
        out = function(values)
        order = np.argsort(values, axis=None, kind="stable")
        assert out.dtype == np.uint8
        assert np.all(np.diff(out.ravel()[order].astype(int)) >= 0)


@settings(deadline=None, max_examples=20)
@given(st.sampled_from(EVERY_FILTER), st.sampled_from(DTYPES), st.integers(0, 2**16), st.integers(8, 40), st.integers(8, 40))
def test_filters_keep_shape_and_input(section, dtype, seed, height, width):
    image = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(dtype)
    before = image.copy()
    image.setflags(write=False)
    out = apply(section, image)
    assert out.shape == image.shape
    assert out.dtype in DTYPES
    assert np.all(np.isfinite(out))
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("section", EVERY_FILTER, ids=lambda s: s.filter)
@pytest.mark.parametrize("dtype", DTYPES)
def test_padded_rows_and_byte_order_make_no_difference(section, dtype):
    image = (thermal() - 2800).astype(dtype)
    padded = np.full((len(image), image.shape[1] + 13), 99, dtype)
    padded[:, : image.shape[1]] = image
    view = padded[:, : image.shape[1]]
    np.testing.assert_allclose(apply(section, view).astype(np.float64), apply(section, image), rtol=1e-5, atol=1e-3)  # alignment changes rounding
    chain = Chain(PreprocessingConfig(filters=(section, cfg.HistogramClip())))
    swapped = view.astype(view.dtype.newbyteorder(">"))
    np.testing.assert_array_equal(chain(swapped, 0), chain(image, 0))


@pytest.mark.parametrize("section", EVERY_FILTER, ids=lambda s: s.filter)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("value", [0, 7, 255])
def test_constant_images_pass_without_a_word(section, dtype, value):
    image = np.full((48, 40), value, dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = apply(section, image)
        chained = Chain(PreprocessingConfig(filters=(section, cfg.HistogramClip())))(image, 0)
    assert np.all(np.isfinite(out))
    if section.filter != "clahe":  # it spreads the clipped part of one bin over all
        assert float(np.ptp(out)) <= 1  # rounding in the bilateral filter
    assert chained.dtype == np.uint8


def test_chain_is_the_papers():
    image = thermal(height=512, width=640)
    denoised = denoise_tv_chambolle(image.astype(np.float64), weight=4.0)
    expected = cv2.medianBlur(he_clip_as_published(np.rint(denoised).astype(np.uint16), 10000, fold=False), 3)
    out = Chain(cfg.load_config("paper").preprocessing)(image, 0)
    assert out.dtype == np.uint8
    difference = np.abs(out.astype(int) - expected)
    assert np.mean(difference <= 1) > 0.99  # the reference rounds to whole counts before its map, one count is about one grey level here


@pytest.mark.parametrize("dtype", DTYPES)
def test_chain_takes_every_type(dtype):
    out = Chain(PreprocessingConfig())((thermal() >> 4).astype(dtype), 0)
    assert out.dtype == np.uint8
    assert out.std() > 30


def test_chain_that_never_gives_8_bit():
    with pytest.raises(ConfigError, match=r"chambolle_tv -> median gives float32(.|\n)*he_clip, he_cdf, stretch"):
        Chain(PreprocessingConfig(filters=(cfg.ChambolleTv(), cfg.Median())))


def test_chain_that_gives_8_bit_only_from_8_bit():
    for sections in ((cfg.Clahe(), cfg.Median()), ()):
        chain = Chain(PreprocessingConfig(filters=sections))
        assert chain((thermal() >> 4).astype(np.uint8), 0).dtype == np.uint8
        with pytest.raises(ConfigError, match="gives uint16 from a uint16 image"):
            chain(thermal(), 0)


def test_unknown_filter_lists_the_known(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("preprocessing: {filters: [{filter: magic}]}\n")
    with pytest.raises(ConfigError) as error:
        cfg.load_config(file=file)
    assert "'magic'" in str(error.value)
    for name in FILTERS:
        assert name in str(error.value)


def test_every_configurable_filter_exists():
    assert {section.filter for section in EVERY_FILTER} == FILTERS.keys()


# ---- a steady window --------------------------------------------------------------------------------------------------------------

SECOND_NS = 1_000_000_000


def test_steady_window_by_hand():
    window = SteadyWindow(2.0)
    assert window.update((100, 200), 0) == (100, 200)
    share = 1 - np.exp(-0.1 / 2.0)
    np.testing.assert_allclose(window.update((110, 230), SECOND_NS // 10), (100 + 10 * share, 200 + 30 * share))
    _, high = window.update((100, 100_000), 2 * SECOND_NS // 10)  # as if at most one width away
    assert high - (200 + 30 * share) == pytest.approx(share * (100 + 20 * share))
    window.reset()
    assert window.update((0, 1), 3 * SECOND_NS // 10) == (0, 1)
    assert window.update((5, 6), 0) == (5, 6), "time was set back"


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(0, 1e4), st.floats(1, 1e4)), min_size=2, max_size=30), st.floats(0.05, 10))
def test_steady_window_stays_a_window_and_moves_slowly(windows_seen, seconds):
    window, before = SteadyWindow(seconds), None
    for index, (low, width) in enumerate(windows_seen):
        limits = window.update((low, low + width), index * SECOND_NS // 10)
        assert limits[1] > limits[0]
        if before is not None:
            most = (1 - np.exp(-0.1 / seconds)) * (before[1] - before[0]) * (1 + 1e-9)
            assert max(abs(limits[0] - before[0]), abs(limits[1] - before[1])) <= most
        before = limits


@pytest.mark.parametrize("name", sorted(LIMITS))
def test_a_stove_does_not_crush_the_rest(name):
    section = next(s for s in EVERY_FILTER if s.filter == name)
    cold, hot = thermal(noise=2.0), thermal(noise=2.0)
    hot[:, :8] += 6000  # a tenth of the image, thirty times hotter than the scene is wide
    alone, steady = Chain(PreprocessingConfig(filters=(section,))), Chain(PreprocessingConfig(filters=(section,), window_s=2.0))
    contrast = {}
    for chain in (alone, steady):
        chain(cold, 0)
        contrast[chain] = np.std(chain(hot, SECOND_NS // 10)[:, 10:])
    usual = np.std(alone(cold, 0)[:, 10:])
    assert contrast[alone] < 0.1 * usual and contrast[steady] > 0.85 * usual
    steady.reset()
    np.testing.assert_array_equal(steady(hot, SECOND_NS // 5), alone(hot, 0), "after a shutter closure the window is the frame's own")


def test_without_a_steady_window_frames_do_not_know_each_other():
    chain = Chain(cfg.load_config("paper").preprocessing)
    first = chain(thermal(0), 0)
    chain(thermal(1) + 3000, 1)
    np.testing.assert_array_equal(chain(thermal(0), 2), first)


@pytest.mark.slow
def test_real_frames(shared_data):
    for name in ("forest_f6_line1", "orchard_m2ea_drone", "sim_room_shutter", "forest_f0"):
        image = next(iter(open_recording(shared_data / name).frames())).image
        denoised = denoise_tv_chambolle(image.astype(np.float32), weight=4.0).astype(np.float32)
        expected = cv2.medianBlur(windows.he_clip(denoised), 3)
        out = Chain(cfg.load_config("paper").preprocessing)(image, 0)
        assert np.mean(np.abs(out.astype(int) - expected) <= 1) >= 0.999, name
        assert out.std() > 35
