"""Reading and preparing ahead."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from test_slam import CAMERA, CONFIG, frames

from thegra_core.config import PreprocessingConfig
from thegra_core.messages import Frame, Shutter, ShutterState
from thegra_core.preprocessing.stage import PreprocessingStage
from thegra_core.sources.read_ahead import read_ahead


def test_so_many_are_taken_before_they_are_asked_for_and_no_more() -> None:
    taken, third = [], threading.Event()

    def numbers() -> Iterator[int]:
        for number in range(1, 8):
            taken.append(number)
            if number == 3:
                third.set()
            yield number

    ahead = read_ahead(numbers(), 2)
    assert next(ahead) == 1 and third.wait(60)
    assert taken == [1, 2, 3]
    assert list(ahead) == [2, 3, 4, 5, 6, 7]


def test_what_goes_wrong_is_raised_in_its_place() -> None:
    def numbers() -> Iterator[int]:
        yield 1
        yield 2
        raise OSError("unreadable")

    ahead = read_ahead(numbers(), 3)
    assert [next(ahead), next(ahead)] == [1, 2]
    with pytest.raises(OSError, match="unreadable"):
        next(ahead)


def test_images_are_the_same_however_early_they_are_made() -> None:
    def prepared(count: int | None) -> list[tuple[bytes, ShutterState | None]]:
        made = map(PreprocessingStage(CONFIG.preprocessing, CAMERA.image_size).process, frames(8))
        return [(b"" if p.image is None else p.image.tobytes(), p.shutter) for p in (made if count is None else read_ahead(made, count))]

    assert prepared(4) == prepared(None)


def test_an_image_of_another_size_is_no_image_of_this_camera() -> None:
    frame = frames(1)[0]
    width, height = CAMERA.image_size
    stage = PreprocessingStage(CONFIG.preprocessing, (width + 1, height))
    assert stage.process(frame).trouble == "image size differs from the camera's" and stage.process(frame).image is None
    unknown = PreprocessingStage(CONFIG.preprocessing).process(frame)
    assert not unknown.trouble and unknown.image is not None and unknown.image.dtype == np.uint8


def _moving(count: int, frozen: range) -> list[np.ndarray]:
    """Images of a camera that moves over a scene, repeated while the shutter is closed."""
    rng = np.random.default_rng(1)
    scene = cv2.GaussianBlur(rng.normal(3000, 1600, (64, 80 + 2 * count)), (0, 0), 4)
    images: list[np.ndarray] = []
    for i in range(count):
        images.append(images[-1] if i in frozen else (scene[:, 2 * i : 2 * i + 80] + rng.normal(0, 3, (64, 80))).astype(np.uint16))
    return images


@pytest.mark.parametrize(("jumps", "frozen", "begins"), [
    (dict.fromkeys(range(30, 60), -50.0), range(45, 50), 45),  # the clock is set back
    ({30: 5000.0}, range(45, 50), 45),  # one stamp lies far ahead
    (dict.fromkeys(range(30, 60), -50.0), range(25, 38), 34),  # the clock is set back behind the shutter: three frames are refused, the next is the first of its time
])  # fmt: skip
def test_the_shutter_is_seen_after_the_clock_was_set(jumps: dict[int, float], frozen: range, begins: int) -> None:
    stage = PreprocessingStage(PreprocessingConfig(), (80, 64))
    stamps = [1_000_000_000_000 + round(1e9 * (0.1 * i + jumps.get(i, 0.0))) for i in range(60)]
    made = [stage.process(Frame(stamp, i, image)) for i, (stamp, image) in enumerate(zip(stamps, _moving(60, frozen), strict=True))]
    closed = [i for i, p in enumerate(made) if p.shutter is not None and p.shutter.shutter is Shutter.CLOSED and i > 33]
    assert closed == list(range(begins, frozen.stop))
    opened = made[frozen.stop].shutter
    assert opened is not None and opened.shutter is Shutter.JUST_OPENED
