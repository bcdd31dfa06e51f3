"""Reading and preparing ahead."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from test_slam import CAMERA, CONFIG, frames

from thegra_core.messages import ShutterState
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
