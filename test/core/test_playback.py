"""A recording at its own rate."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from thegra_core.messages import Frame
from thegra_core.sources.playback import Playback

IMAGE = np.zeros((2, 2), np.uint8)


def frames(count: int, period_s: float = 0.0) -> list[Frame]:
    return [Frame(round(1e9 * (100 + i * period_s)), i, IMAGE) for i in range(count)]


def test_who_is_fast_enough_gets_every_frame() -> None:
    taken = threading.Semaphore(1)

    def one_by_one() -> Iterator[Frame]:
        for frame in frames(50):
            taken.acquire()
            yield frame

    with Playback(one_by_one()) as playback:
        got = []
        for frame in playback:
            got.append(frame.index)
            taken.release()
    assert got == list(range(50)) and playback.dropped == 0


def test_who_is_too_slow_loses_the_oldest() -> None:
    delivered = threading.Event()

    def all_at_once() -> Iterator[Frame]:
        yield from frames(20)
        delivered.set()

    with Playback(all_at_once(), waiting=3) as playback:
        stream = iter(playback)
        got = [next(stream).index]
        assert delivered.wait(10)
        got += [frame.index for frame in stream]
    assert got[-3:] == [17, 18, 19] and len(got) <= 4
    assert playback.dropped == 20 - len(got)


def test_frames_come_when_their_stamps_say() -> None:
    begin = time.monotonic()
    with Playback(iter(frames(5, 0.02))) as playback:
        late_ms = [playback.latency_ms() for _ in playback]
    assert time.monotonic() - begin > 0.07, "the last frame is due after 0.08 s"
    assert len(late_ms) + playback.dropped == 5 and min(late_ms) > -1


def test_an_error_of_the_reader_is_raised_to_who_iterates() -> None:
    def broken() -> Iterator[Frame]:
        yield frames(1)[0]
        raise ValueError("torn file")

    with Playback(broken()) as playback:
        stream = iter(playback)
        assert next(stream).index == 0
        with pytest.raises(ValueError, match="torn file"):
            next(stream)


def test_leaving_ends_the_thread_at_once() -> None:
    with Playback(iter(frames(2, 3600.0))) as playback:
        assert next(iter(playback)).index == 0
    assert not playback._thread.is_alive()
