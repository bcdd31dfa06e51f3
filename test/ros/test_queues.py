"""Between the callbacks and the working thread: what waits, what goes, what time says."""

from __future__ import annotations

import threading

from hypothesis import given
from hypothesis import strategies as st

from thegra_ros.frame_queue import LatestQueue
from thegra_ros.stamp_watch import LEAST_JUMP_NS, StampWatch

S = 10**9


def drain(queue: LatestQueue[int]) -> list[int]:
    return [queue.get() for _ in range(len(queue))]  # type: ignore[misc]


@given(st.integers(1, 5), st.lists(st.integers(), max_size=20))
def test_a_full_queue_drops_the_oldest_and_counts_it(size: int, items: list[int]) -> None:
    queue: LatestQueue[int] = LatestQueue(size)
    gone = [queue.put(item) for item in items]
    assert gone == [None] * min(size, len(items)) + items[:-size]
    assert queue.dropped == max(0, len(items) - size)
    assert drain(queue) == items[-size:]


def test_a_waiting_thread_gets_what_comes_and_ends_when_the_queue_closes() -> None:
    queue: LatestQueue[int] = LatestQueue(3)
    got: list[int | None] = []
    received = threading.Event()

    def take() -> None:
        while (item := queue.get()) is not None:
            got.append(item)
            received.set()

    thread = threading.Thread(target=take)
    thread.start()
    queue.put(1)
    assert received.wait(60)
    queue.close()
    thread.join(60)
    assert not thread.is_alive() and got == [1]
    queue.put(2)
    assert queue.get() is None and len(queue) == 0


def test_what_is_cleared_does_not_count_as_dropped() -> None:
    queue: LatestQueue[int] = LatestQueue(2)
    queue.put(1)
    queue.clear()
    assert (len(queue), queue.dropped) == (0, 0)


def test_what_is_put_first_is_never_dropped() -> None:
    queue: LatestQueue[int] = LatestQueue(1)
    queue.put(1)
    assert queue.put_first(-1) and queue.put_first(-2)
    queue.put(2)
    queue.clear()
    queue.put(3)
    assert [queue.get() for _ in range(2)] == [-1, -2]
    assert queue.get() == 3 and queue.put_first(-3)
    assert queue.close() == [-3] and not queue.put_first(-4)


def told(stamps: list[int]) -> list[int]:
    """Indices at which the stream begins anew."""
    watch = StampWatch()
    return [i for i, stamp in enumerate(stamps) if watch.begins_anew(stamp)]


def test_a_bag_that_loops_begins_anew_once_a_turn() -> None:
    turn = [100 * S + i * S // 10 for i in range(50)]
    assert told(turn * 3) == [51, 101]


@given(st.lists(st.integers(0, 50), min_size=2, max_size=40))
def test_stamps_out_of_order_within_a_second_are_no_beginning(steps: list[int]) -> None:
    assert told([100 * S + step * LEAST_JUMP_NS // 50 for step in steps]) == []


def test_one_wrong_stamp_is_no_beginning() -> None:
    regular = [100 * S + i * S // 10 for i in range(20)]
    assert told([*regular[:10], 10**6 * S, *regular[10:]]) == []
    assert told([*regular[:10], 0, *regular[10:]]) == []
    assert told([*regular[:10], 0, 0, *regular[10:]]) == [], "a driver that twice leaves the stamp out"
