"""The sensor's level and fixed pattern, followed through scenes that change and a camera that stops."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thegra_core.preprocessing.sensor import SensorLook, SensorWatch

SHAPE = (128, 160)


def scene(seed=0, size=(400, 500), contrast=60.0, blur=3.0):
    """A smooth random picture (counts) to look at a part of."""
    picture = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, size), (0, 0), blur)
    return contrast * picture / picture.std()


def view(picture, i, speed=3, at=(20, 20)):
    y, x = at[0] + i, at[1] + speed * i
    return picture[y : y + SHAPE[0], x : x + SHAPE[1]]


def pattern(seed, sigma=4.0):
    return np.random.default_rng(1000 + seed).normal(0, sigma, SHAPE)


def shot(scenery, fixed, i, noise=3.0, level=3000.0, dtype=np.uint16):
    return np.clip(level + scenery + fixed + np.random.default_rng(i).normal(0, noise, SHAPE), 0, 65535).astype(dtype)


def watch(images):
    """(frame, change) of every change."""
    sensor = SensorWatch()
    return [(i, change) for i, image in enumerate(images) if (change := sensor.update(SensorLook.at(image)))]


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_change_of_pattern_is_seen_at_once_and_only_once(dtype):
    picture = scene()
    images = [shot(view(picture, i), pattern(i >= 30), i, dtype=dtype) for i in range(60)]
    ((frame, change),) = watch(images)
    assert frame == 30
    assert change.startswith("the fixed pattern changed")


def test_second_change_is_seen():
    picture = scene()
    assert [frame for frame, _ in watch([shot(view(picture, i), pattern(i // 30), i) for i in range(90)])] == [30, 60]


def test_new_scene_is_no_change_of_pattern():
    """From a faint scene into one of strong, fine texture: the pattern is a small part of it and still there."""
    faint, strong = scene(0), scene(1, contrast=300.0, blur=1.5)
    assert watch([shot(view(strong if i >= 30 else faint, i % 30), pattern(0), i, level=3000 + 2 * i) for i in range(60)]) == []


def test_camera_that_stands_and_starts_to_move():
    """While nothing moves the scene's own detail looks like a pattern; a sensor without one must not be thought to have lost it."""
    textured = scene(2, contrast=200.0, blur=1.0)
    for fixed in (0.0, pattern(0)):
        still_then_moving = [shot(view(textured, max(0, i - 30)), fixed, i) for i in range(60)]
        assert watch(still_then_moving) == []
        stop_and_go = [shot(view(textured, i // 15 * 5 + min(i % 15, 5)), fixed, i) for i in range(90)]
        assert watch(stop_and_go) == []


def test_jump_of_level():
    picture = scene(contrast=10.0)
    images = [shot(view(picture, i, speed=1), 0.0, i, level=3000.0 + 200.0 * (i >= 20)) for i in range(40)]
    ((frame, change),) = watch(images)
    assert frame == 20
    assert change == "the level of the whole image jumped by 200"


def test_level_of_video_that_follows_the_scene_says_nothing():
    picture = scene(contrast=5.0)
    assert watch([shot(view(picture, i, speed=1), 0.0, i, level=60.0 + 90.0 * (i >= 20), dtype=np.uint8) for i in range(40)]) == []


def test_slow_drift_and_an_object_that_enters():
    picture = scene(contrast=10.0)
    images = []
    for i in range(60):
        image = shot(view(picture, i, speed=1), 0.0, i, level=3000.0 + 3.0 * i)
        if i >= 30:
            image[:, :60] = 9000
        images.append(image)
    assert watch(images) == []


def test_blade_is_flat_and_a_wall_that_comes_near_is_not():
    picture = scene()
    sensor = SensorWatch()
    for i in range(20):
        sensor.update(SensorLook.at(shot(view(picture, i), pattern(0), i)))
    assert sensor.is_flat(SensorLook.at(shot(0.0, 0.0, 99)))
    fading = SensorWatch()
    for i in range(60):
        look = SensorLook.at(shot(0.93**i * view(picture, i), 0.0, i))
        assert not fading.is_flat(look), i
        fading.update(look)


def test_change_of_size_begins_anew():
    picture = scene()
    images = [shot(view(picture, i), pattern(0), i) for i in range(30)]
    assert watch([*images, *(image[:64] for image in images)]) == []
