"""The thread between the queue and the engine."""

from __future__ import annotations

import multiprocessing
import threading
from pathlib import Path

import numpy as np
import pytest

from thegra_core.config import load_config
from thegra_core.errors import InputError, WeightsError
from thegra_core.messages import Frame, TrackingResult, TrackingState
from thegra_core.simulation.cameras import thermal_camera
from thegra_ros.engine import BeginIn, Done, EngineError, Job, LocalEngine, Order, SaveMap
from thegra_ros.image_slot import MOST_BYTES, make_slot, put, take
from thegra_ros.worker import MOST_FAILURES, NotWorkingError, Worker

LIMIT_S = 60


class FakeEngine:
    """Fails where it is told to."""

    def __init__(self, start: Exception | None = None, process: list[Exception | None] | None = None) -> None:
        self.failure, self.answers = start, list(process or [])
        self.stopped = 0

    def start(self) -> None:
        if self.failure is not None:
            raise self.failure

    def process(self, job: Job) -> Done:
        failure = self.answers.pop(0) if self.answers else None
        if failure is not None:
            raise failure
        return Done(TrackingResult(job.frame.stamp_ns, TrackingState.LOST))

    def obey(self, order: Order) -> str:
        assert isinstance(order, SaveMap)
        if order.path.name == "refused":
            raise InputError("no map yet")
        if order.path.name == "fails":
            raise EngineError("killed")
        return f"written to {order.path}"

    def stop(self) -> None:
        self.stopped += 1


class Harness:
    """A worker over engines made in advance; what it said and did."""

    def __init__(self, *engines: FakeEngine) -> None:
        self.engines, self.made = list(engines), 0
        self.done: list[int] = []
        self.unwanted: set[int] = set()
        self.epochs: dict[int, int] = {}
        self.failures: list[tuple[str, bool]] = []
        self.refused: list[tuple[int, str]] = []
        self.changed = threading.Condition()
        self.worker: Worker[int] = Worker(self._make, 100, self._job, self._on_done, self._on_failure, self._on_refused)
        self.worker.start()

    def _make(self) -> FakeEngine:
        self.made += 1
        return self.engines[self.made - 1]

    def _job(self, item: int) -> Job | None:
        if item in self.unwanted:
            return None
        return Job(Frame(item, item, np.zeros((2, 2), np.uint8)), thermal_camera((2, 2)), self.epochs.get(item, 0))

    def _on_done(self, item: int, done: Done, ms: float) -> None:
        with self.changed:
            self.done.append(done.result.stamp_ns)
            self.changed.notify_all()

    def _on_failure(self, text: str, final: bool) -> None:
        with self.changed:
            self.failures.append((text, final))
            self.changed.notify_all()

    def _on_refused(self, item: int, text: str) -> None:
        with self.changed:
            self.refused.append((item, text))
            self.changed.notify_all()

    def wait(self, condition) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, LIMIT_S)


def test_items_are_worked_on_in_order() -> None:
    harness = Harness(FakeEngine())
    for item in range(5):
        harness.worker.queue.put(item)
    harness.wait(lambda: harness.done == [0, 1, 2, 3, 4])
    harness.worker.stop()
    assert harness.failures == [] and harness.engines[0].stopped


@pytest.mark.parametrize("failure", [EngineError("killed"), RuntimeError("a fault")])
def test_a_failed_engine_is_replaced(failure: Exception) -> None:
    harness = Harness(FakeEngine(process=[None, failure]), FakeEngine())
    for item in range(4):
        harness.worker.queue.put(item)
    harness.wait(lambda: harness.done == [0, 2, 3])
    harness.worker.stop()
    assert harness.made == 2 and len(harness.failures) == 1 and str(failure) in harness.failures[0][0] and not harness.failures[0][1]


def test_an_engine_that_never_works_is_given_up() -> None:
    harness = Harness(*[FakeEngine(start=EngineError("no")) for _ in range(MOST_FAILURES + 1)])
    harness.wait(lambda: len(harness.failures) == MOST_FAILURES)
    harness.worker.stop()
    assert [final for _, final in harness.failures] == [False] * (MOST_FAILURES - 1) + [True]
    assert harness.made == MOST_FAILURES


def test_what_the_user_must_put_right_is_not_tried_again() -> None:
    harness = Harness(FakeEngine(start=WeightsError("fetch them")))
    harness.wait(lambda: bool(harness.failures))
    harness.worker.stop()
    assert harness.failures == [("fetch them", True)] and harness.made == 1
    assert harness.worker.given_up


def test_an_epoch_that_cannot_be_begun_is_told_once_and_the_next_is_another_try() -> None:
    """A map of another camera: it is so for each frame, until there is another camera or another map."""
    wrong = InputError("the map is of another camera")
    engine = FakeEngine(process=[None, wrong, wrong, None])
    harness = Harness(engine)
    harness.epochs = {0: 0, 1: 1, 2: 1, 3: 1, 4: 2, 5: 2, 6: 3, 7: 3}
    for item in harness.epochs:
        harness.worker.queue.put(item)
    harness.wait(lambda: harness.done == [0, 6, 7])
    assert harness.worker.ask(SaveMap(Path("/a/map"))).result(LIMIT_S) == "written to /a/map", "orders are obeyed all the while"
    harness.worker.stop()
    assert harness.refused == [(1, str(wrong)), (4, str(wrong))]
    assert harness.failures == [] and harness.made == 1 and not harness.worker.given_up


def test_orders_are_answered_and_a_refused_one_changes_nothing() -> None:
    harness = Harness(FakeEngine(), FakeEngine())
    happened: list[str] = []
    assert harness.worker.ask(SaveMap(Path("/a/map")), lambda: happened.append("then")).result(LIMIT_S) == "written to /a/map"
    with pytest.raises(InputError, match="no map yet"):
        harness.worker.ask(SaveMap(Path("/a/refused")), lambda: happened.append("never")).result(LIMIT_S)
    assert happened == ["then"] and harness.made == 1
    with pytest.raises(EngineError, match="killed"):
        harness.worker.ask(SaveMap(Path("/a/fails"))).result(LIMIT_S)
    harness.unwanted.add(1)
    for item in (1, 2):
        harness.worker.queue.put(item)
    harness.wait(lambda: harness.done == [2])
    assert harness.made == 2, "what failed was replaced"
    harness.worker.stop()
    with pytest.raises(NotWorkingError):
        harness.worker.ask(SaveMap(Path("/a/map"))).result(LIMIT_S)


def test_orders_that_wait_when_the_engine_is_given_up_are_refused() -> None:
    harness = Harness(FakeEngine(start=WeightsError("fetch them")))
    with pytest.raises(NotWorkingError, match="diagnostics"):
        harness.worker.ask(SaveMap(Path("/a/map"))).result(LIMIT_S)
    harness.worker.stop()


def test_another_epoch_begins_a_new_map(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[object] = []

    class FakeSlam:
        def __init__(self, camera, config, *networks, keep_records=True, **others) -> None:
            assert not keep_records, 'a live stream has no end'
            made.append(networks)

        def process(self, frame: Frame) -> TrackingResult:
            if frame.index == 9:
                raise ZeroDivisionError
            return TrackingResult(frame.stamp_ns, TrackingState.INITIALIZING)

        def close(self) -> None:
            pass

    monkeypatch.setattr("thegra_core.slam.Slam", FakeSlam)
    engine = LocalEngine(load_config("fast", overrides={"extractor.name": "orb"}))
    engine.start()
    camera = thermal_camera((2, 2))
    for index, epoch in ((0, 0), (1, 0), (2, 1), (3, 1)):
        engine.process(Job(Frame(index, index, np.zeros((2, 2), np.uint8)), camera, epoch))
    assert len(made) == 2 and made[0][0] is made[1][0], "the networks stay"
    with pytest.raises(EngineError, match="ZeroDivisionError"):
        engine.process(Job(Frame(9, 9, np.zeros((2, 2), np.uint8)), camera, 1))
    engine.process(Job(Frame(10, 10, np.zeros((2, 2), np.uint8)), camera, 1))
    assert len(made) == 3, "what failed may be in any state"


@pytest.mark.parametrize("image", [np.arange(12, dtype=np.uint16).reshape(3, 4), np.arange(24, dtype=np.float32).reshape(4, 6)[::2, ::3], np.zeros((0, 5), np.uint8)])
def test_an_image_comes_out_of_the_slot_as_it_was_put(image: np.ndarray) -> None:
    slot = make_slot(multiprocessing.get_context("spawn"))
    put(slot, Frame(1, 0, np.full((9, 9), 7, np.uint16)))
    left = put(slot, Frame(2, 5, image))
    taken = take(slot, left)
    put(slot, Frame(3, 1, np.full((9, 9), 7, np.uint16)))
    assert (taken.stamp_ns, taken.index, taken.image.dtype) == (2, 5, image.dtype)
    np.testing.assert_array_equal(taken.image, image)


def test_an_image_without_room_in_the_slot_goes_as_it_is() -> None:
    slot = make_slot(multiprocessing.get_context("spawn"))
    large = Frame(2, 5, np.zeros((MOST_BYTES // 1000 + 1, 1000), np.uint8))
    assert put(slot, large) is large and take(slot, large) is large


def test_a_map_that_cannot_be_loaded_leaves_the_one_that_is_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made: list[object] = []

    class FakeSlam:
        def __init__(self, *arguments, **options) -> None:
            made.append(self)

        def process(self, frame: Frame) -> TrackingResult:
            return TrackingResult(frame.stamp_ns, TrackingState.INITIALIZING)

        def load_map(self, path: Path) -> None:
            raise InputError(f"{path} is not there")

        def close(self) -> None:
            pass

    monkeypatch.setattr("thegra_core.slam.Slam", FakeSlam)
    engine = LocalEngine(load_config("fast", overrides={"extractor.name": "orb"}))
    camera = thermal_camera((2, 2))
    engine.process(Job(Frame(0, 0, np.zeros((2, 2), np.uint8)), camera, 0))
    with pytest.raises(InputError, match="not there"):
        engine.obey(BeginIn(tmp_path / "none.map", camera, 1))
    engine.process(Job(Frame(1, 1, np.zeros((2, 2), np.uint8)), camera, 1))
    assert len(made) == 2, "one for the first frame, one that could not be used"
