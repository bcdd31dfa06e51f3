"""Frames read from disk while those before them are worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

from thegra_core.messages import Frame

AHEAD = 2
"""Frames that are read before they are asked for."""


def read_ahead(frames: Iterator[Frame]) -> Iterator[Frame]:
    """The same frames, read by a thread of its own; decoding an image takes no less time than following its keypoints."""
    with ThreadPoolExecutor(1, "thegra reading") as reader:
        waiting = deque(reader.submit(next, frames, None) for _ in range(AHEAD))
        while (frame := waiting.popleft().result()) is not None:
            waiting.append(reader.submit(next, frames, None))
            yield frame
