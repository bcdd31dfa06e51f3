"""Each term of the sensor does what its parameter says, and nothing else does it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thegra_core.simulation.sensor import Sensor
from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.simulation.timing import Fate, make_schedule

SIZE = (160, 128)
FLAT = np.full((128, 160), 293.15)
QUIET = SensorConfig(
    optics_blur_px=0, netd_mk=0, pattern_netd=0, column_netd=0, pattern_growth=0, offset_drift_k=0, dome_k_per_min=0, offset_jump_k=0, dead_pixels=0, counts_per_kelvin=50
)


def sensor(seed: int = 0, **parameters) -> Sensor:
    """A perfect sensor but for the parameters given."""
    return Sensor(QUIET.model_copy(update=parameters), SIZE, seed)


def test_a_perfect_sensor_counts_kelvins_and_clips() -> None:
    image = sensor().expose(FLAT + 2.0, 0.0)
    assert image.dtype == np.uint16 and np.all(image == 7000 + 100)
    assert np.all(sensor(bits=14).expose(FLAT + 500, 0.0) == (1 << 14) - 1) and np.all(sensor().expose(FLAT - 250, 0.0) == 0)


def test_temporal_noise_is_the_netd() -> None:
    camera = sensor(netd_mk=60.0)
    first, second = (camera.expose(FLAT, t).astype(float) for t in (0.0, 0.1))
    assert (second - first).std() / np.sqrt(2) == pytest.approx(60e-3 * 50, rel=0.03)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.03


def test_fixed_pattern_stays_and_is_as_strong_as_asked_for() -> None:
    camera = sensor(netd_mk=50.0, pattern_netd=2.0)
    mean = np.mean([camera.expose(FLAT, 0.04 * k) for k in range(60)], axis=0)
    assert mean.std() == pytest.approx(2.0 * 50e-3 * 50, rel=0.05)


def test_column_stripes_are_columns() -> None:
    image = sensor(netd_mk=50.0, column_netd=2.0)
    kelvin = image.pattern_k()
    assert np.all(kelvin == kelvin[0]) and kelvin[0].std() == pytest.approx(2.0 * 50e-3, rel=0.2)


def test_pattern_grows_until_the_next_correction_and_is_another_one_then() -> None:
    camera = sensor(netd_mk=50.0, pattern_netd=0.4, pattern_growth=1.0)
    camera.expose(FLAT, 0.0)
    fresh = camera.pattern_k()
    for t in np.arange(1.0, 121.0):
        camera.expose(FLAT, t)
    grown = camera.pattern_k()
    assert fresh.std() == pytest.approx(0.4 * 50e-3, rel=0.05)
    assert grown.std() == pytest.approx(np.hypot(0.4, 2.0) * 50e-3, rel=0.05)
    camera.correct(121.0)
    assert camera.pattern_k().std() == pytest.approx(0.4 * 50e-3, rel=0.05)
    assert abs(np.corrcoef(camera.pattern_k().ravel(), fresh.ravel())[0, 1]) < 0.05


def test_growing_pattern_forgets_within_its_time() -> None:
    camera = sensor(netd_mk=50.0, pattern_growth=1.0, pattern_time_s=10.0)
    for t in (0.0, 60.0):
        camera.expose(FLAT, t)
    before = camera.pattern_k()
    camera.expose(FLAT, 70.0)
    assert np.corrcoef(camera.pattern_k().ravel(), before.ravel())[0, 1] == pytest.approx(np.exp(-1), abs=0.05)


def test_level_jumps_at_a_correction_and_only_there() -> None:
    jumps = []
    for seed in range(60):
        camera = sensor(seed, offset_jump_k=0.5)
        before = camera.expose(FLAT, 0.0)[0, 0]
        assert camera.expose(FLAT, 1.0)[0, 0] == before
        camera.correct(2.0)
        jumps.append((float(camera.expose(FLAT, 2.0)[0, 0]) - float(before)) / 50)
    assert np.std(jumps) == pytest.approx(0.5, rel=0.3)


def test_level_wanders_by_the_root_of_time() -> None:
    levels = []
    for seed in range(60):
        camera = sensor(seed, offset_drift_k=0.2)
        camera.expose(FLAT, 0.0)
        for t in (60.0, 120.0, 240.0):
            camera.expose(FLAT, t)
        levels.append(camera.offset_k)
    assert np.std(levels) == pytest.approx(0.2 * 2, rel=0.3)


def test_corners_warm_against_the_middle() -> None:
    camera = sensor(dome_k_per_min=0.5)
    camera.expose(FLAT, 0.0)
    image = camera.expose(FLAT, 120.0).astype(float)
    assert image[0, 0] - image[64, 80] == pytest.approx(1.0 * 50, abs=1)


def test_blur_spreads_an_edge_and_keeps_the_mean() -> None:
    edge = FLAT + 20.0 * (np.arange(160) >= 80)
    image = sensor(optics_blur_px=1.5).expose(edge, 0.0).astype(float)
    slope = np.diff(image[64])
    spread = np.sqrt(np.average((np.arange(159) + 0.5 - 79.5 - 0.5) ** 2, weights=slope))
    assert spread == pytest.approx(1.5, abs=0.3) and image.mean() == pytest.approx(7000 + 10 * 50, abs=1)


def test_dead_pixels_are_as_many_as_asked_for_and_stay_dead() -> None:
    camera = sensor(dead_pixels=0.01)
    first, second = camera.expose(FLAT, 0.0), camera.expose(FLAT + 5, 0.1)
    dead = first != 7000
    assert np.count_nonzero(dead) == round(0.01 * first.size)
    assert np.array_equal(second != 7250, dead) and np.array_equal(first[dead], second[dead])


@pytest.mark.parametrize("agc", ["linear", "plateau"])
def test_automatic_gain_fills_eight_bits_and_follows_slowly(agc: str) -> None:
    ramp = FLAT + np.linspace(0, 4, FLAT.size).reshape(FLAT.shape)
    camera = sensor(agc=agc, agc_time_s=1.0)
    first = camera.expose(ramp, 0.0)
    assert first.dtype == np.uint8 and first.min() < 5 and first.max() > 250
    assert np.all(np.diff(first.ravel().astype(int)) >= 0)
    soon = camera.expose(ramp + 2, 0.1)
    assert soon.mean() > first.mean() + 30, "the gain has not followed yet"
    late = camera.expose(ramp + 2, 20.0)
    assert np.abs(late.astype(int) - first).max() <= 2


def test_the_same_seed_gives_the_same_counts() -> None:
    config = SensorConfig()
    images = [Sensor(config, SIZE, seed).expose(FLAT, 0.0) for seed in (4, 4, 5)]
    assert np.array_equal(images[0], images[1]) and not np.array_equal(images[0], images[2])


def test_time_does_not_go_back_and_images_keep_their_size() -> None:
    camera = sensor()
    camera.expose(FLAT, 1.0)
    with pytest.raises(ValueError, match="time goes back"):
        camera.expose(FLAT, 0.5)
    with pytest.raises(ValueError, match="160x128"):
        camera.expose(FLAT[:10], 2.0)


# ---- timing ---------------------------------------------------------------------------------------------------------------------------

TIMES = (np.arange(200) * 100_000_000).astype(np.int64)


def test_a_short_recording_has_one_closure_of_the_length_asked_for() -> None:
    schedule = make_schedule(TIMES, SensorConfig(closure_s=0.9), True, 0)
    ((begin, end),) = schedule.closures
    assert TIMES[end] - TIMES[begin] == 900_000_000
    assert [fate is Fate.BLIND for fate in schedule.fates] == [begin <= i < end for i in range(200)]
    assert make_schedule(TIMES, SensorConfig(), False, 0).closures == ()


def test_a_long_recording_has_one_closure_a_period() -> None:
    closures = make_schedule(TIMES, SensorConfig(closure_period_s=5.0, closure_s=0.5), True, 0).closures
    assert [begin for begin, _ in closures] == [50, 100, 150] and all(end - begin == 5 for begin, end in closures)


def test_frames_are_lost_at_the_rate_asked_for_but_never_the_first() -> None:
    times = (np.arange(20000) * 10_000_000).astype(np.int64)
    fates = make_schedule(times, SensorConfig(frame_drop=0.1), False, 0).fates
    assert np.mean([fate is Fate.DROPPED for fate in fates]) == pytest.approx(0.1, abs=0.01) and fates[0] is Fate.SEEN


def test_stamps_jitter_about_the_time_and_stay_in_order() -> None:
    schedule = make_schedule(TIMES, SensorConfig(stamp_jitter_us=2000), False, 0)
    assert (schedule.stamps_ns - TIMES).std() == pytest.approx(2e6, rel=0.3)
    wild = make_schedule((np.arange(200) * 1_000_000).astype(np.int64), SensorConfig(stamp_jitter_us=20000), False, 0)
    assert np.all(np.diff(wild.stamps_ns) > 0)
    assert np.array_equal(make_schedule(TIMES, SensorConfig(), False, 0).stamps_ns, TIMES)


def test_every_parameter_says_what_it_is() -> None:
    for name, field in SensorConfig.model_fields.items():
        assert field.description and len(field.description) > 20, name


def test_the_documented_parameters_are_those_there_are() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "simulator.md").read_text(encoding="utf-8")
    for name, parameter in SensorConfig.model_fields.items():
        default = parameter.default if isinstance(parameter.default, str) else f"{parameter.default:g}"
        assert f"| `{name}` | {default} | {parameter.description} |" in page
