"""A recording played at its own rate, as a camera delivers: who is too slow loses the oldest images."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from types import TracebackType

from thegra_core.messages import Frame

NS_PER_S = 1e9


class Playback:
    """Iterate over it once, as a context manager, for the frames that were not lost.

    Time begins with the first frame that is asked for. Each is delivered when as much time has passed as its stamp lies behind the first one's; a stamp that
    goes back is delivered at once. A frame is read from disk before it is due, by a thread.

    Args:
        frames: In the order of the recording.
        waiting: Frames that may wait for whoever iterates; one more and the oldest is dropped, as by a queue of that depth.
        clock: Seconds, monotonic.
    """

    def __init__(self, frames: Iterator[Frame], waiting: int = 3, clock: Callable[[], float] = time.monotonic) -> None:
        self.dropped = 0
        self._frames = frames
        self._clock = clock
        self._queue: deque[tuple[Frame, float]] = deque()
        self._waiting = waiting
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        self._ended = False
        self._error: BaseException | None = None
        self._due_s = 0.0
        self._thread = threading.Thread(target=self._play, name="thegra playback", daemon=True)

    def __enter__(self) -> Playback:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stopped.set()
        if self._thread.ident is not None:
            self._thread.join()

    def __iter__(self) -> Iterator[Frame]:
        self._thread.start()
        while True:
            with self._changed:
                while not self._queue and not self._ended:
                    self._changed.wait()
                if not self._queue:
                    if self._error is not None:
                        raise self._error
                    return
                frame, self._due_s = self._queue.popleft()
            yield frame

    def latency_ms(self) -> float:
        """Milliseconds since the frame given last was delivered."""
        return 1e3 * (self._clock() - self._due_s)

    def _play(self) -> None:
        try:
            begin_s, first_ns = 0.0, None
            for frame in self._frames:
                if first_ns is None:
                    begin_s, first_ns = self._clock(), frame.stamp_ns
                due_s = begin_s + (frame.stamp_ns - first_ns) / NS_PER_S
                if self._stopped.wait(max(0.0, due_s - self._clock())):
                    return
                self._deliver(frame, due_s)
        except Exception as error:  # raised where the frames are asked for
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def _deliver(self, frame: Frame, due_s: float) -> None:
        with self._changed:
            if len(self._queue) == self._waiting:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append((frame, due_s))
            self._changed.notify()
