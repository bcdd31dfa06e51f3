"""The four stages as nodes, for tests."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from ros_graph import LIMIT_S, Graph

from thegra_core.messages import Frame

RETRY_S = 2.0
STAGES = ("preprocessing", "frontend", "tracking", "mapping")


def noisy_copies(frame: Frame, begin_ns: int) -> Iterator[Frame]:
    """Images of a camera that stands still, a tenth of a second apart."""
    rng = np.random.default_rng(0)
    for step in itertools.count():
        noise = rng.normal(0, 5, frame.image.shape)
        yield Frame(begin_ns + step * 100_000_000, 0, (frame.image + noise).astype(np.uint16))


_clock = itertools.count(1)


def again(frames: list[Frame]) -> Iterator[Frame]:
    """The frames over and over, with stamps that go on rising, a tenth of a second apart."""
    for frame in itertools.cycle(frames):
        yield replace(frame, stamp_ns=1_700_000_100_000_000_000 + next(_clock) * 100_000_000)


class Stages:
    """The four nodes; frames go in step, so that each is matched to the newest reference."""

    def __init__(self, graph: Graph, camera, first: Frame, **parameters: dict[str, str]) -> None:
        self.graph, self._parameters = graph, parameters
        self.nodes = {name: graph.start(f"thegra_ros.nodes.{name}", parameters.get(name)) for name in STAGES}
        graph.wait(lambda: all(self.works(name) for name in STAGES), "four nodes")
        graph.send_camera(camera, "tracking", "mapping")
        # a stream finds its listeners; what is sent before is lost
        self.send_until(noisy_copies(first, first.stamp_ns + 100 * 10**9), lambda: self.value("tracking", "processed") > 0, "a frame that reaches tracking")
        self.begin_again(first)

    def works(self, name: str) -> bool:
        return any(m.status[0].name.endswith(name) and m.status[0].message != "the node is not active" for m in self.graph.received["/diagnostics"])

    def value(self, node: str, key: str) -> int:
        return int(self.graph.said(node, key) or 0)

    def send(self, frames: list[Frame]) -> None:
        for frame in frames:
            done = self.value("tracking", "processed")
            self.graph.send([frame])
            self.graph.wait(lambda n=done: self.value("tracking", "processed") > n, f"frame {frame.index}")

    def begin_again(self, first: Frame) -> None:
        """Send an image of before the first: with that, the second one of the past, all begins anew."""
        came = self.value("preprocessing", "images")
        self.graph.send([next(noisy_copies(first, first.stamp_ns - 100_000_000))])
        self.graph.wait(lambda: self.value("preprocessing", "images") > came, "an image of the past")

    def send_until(self, frames: Iterator[Frame], reached: Callable[[], bool], what: str) -> None:
        """Send frames until something is so, each when the one before was worked on; what is lost while a node finds the others is not waited for."""
        end = time.monotonic() + LIMIT_S
        while not reached():
            assert time.monotonic() < end, f"waited in vain for {what}"
            done = self.value("tracking", "processed")
            self.graph.send([next(frames)])
            self.graph.spin_until(lambda n=done: self.value("tracking", "processed") > n or reached(), RETRY_S)

    def poses_come(self, frames: list[Frame], least: int, what: str) -> None:
        """Send frames over and over until so many more of them have a pose."""
        before = len(self.graph.received["pose"])
        self.send_until(again(frames), lambda: len(self.graph.received["pose"]) >= before + least, what)

    def restart(self, name: str, camera) -> None:
        """Kill a node, and start it again."""
        self.nodes[name].process.kill()
        self.nodes[name].process.wait()
        self.graph.forget(self.nodes[name])
        self.graph.received["/diagnostics"].clear()
        self.nodes[name] = self.graph.start(f"thegra_ros.nodes.{name}", self._parameters.get(name))
        self.graph.wait(lambda: self.works(name), f"{name} again")
        if name in ("tracking", "mapping"):
            self.graph.send_camera(camera, name)

    def end(self) -> list[int]:
        return [node.end() for node in self.nodes.values()]
