"""The four stages as nodes, for tests."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from ros_graph import Graph

from thegra_core.messages import Frame

STAGES = ("preprocessing", "frontend", "tracking", "mapping")


def value(graph: Graph, node: str, key: str) -> int:
    """What a node last said on /diagnostics."""
    for message in reversed(graph.received["/diagnostics"]):
        if message.status[0].name.endswith(node):
            return int(next((v.value for v in message.status[0].values if v.key == key), "0"))
    return 0


def noisy_copies(frame: Frame, begin_ns: int) -> Iterator[Frame]:
    """Images of a camera that stands still, a tenth of a second apart."""
    rng = np.random.default_rng(0)
    for step in itertools.count():
        noise = rng.normal(0, 5, frame.image.shape)
        yield Frame(begin_ns + step * 100_000_000, 0, (frame.image + noise).astype(np.uint16))


_clock = itertools.count(1)


def again(frames: list[Frame]) -> Iterator[Frame]:
    """The frames with stamps that go on rising, a tenth of a second apart."""
    for frame in frames:
        yield replace(frame, stamp_ns=1_700_000_100_000_000_000 + next(_clock) * 100_000_000)


class Stages:
    """The four nodes; frames go in step, so that each is matched to the newest reference."""

    def __init__(self, graph: Graph, camera, first: Frame, **parameters: dict[str, str]) -> None:
        self.graph = graph
        self.nodes = {name: graph.start(f"thegra_ros.nodes.{name}", parameters.get(name)) for name in STAGES}
        graph.wait(lambda: all(self.works(name) for name in STAGES), "four nodes")
        graph.send_camera(camera, listeners=2)
        warm_up = noisy_copies(first, first.stamp_ns + 100 * 10**9)  # a stream finds its listeners; what is sent before is lost
        while self.value("tracking", "processed") == 0:
            graph.send([next(warm_up)])
            graph.spin_for(1.0)
        graph.send([next(noisy_copies(first, first.stamp_ns - 100_000_000))])  # stamps go back: with the second image, the test's first, all begins anew

    def works(self, name: str) -> bool:
        return any(m.status[0].name.endswith(name) and m.status[0].message != "the node is not active" for m in self.graph.received["/diagnostics"])

    def value(self, node: str, key: str) -> int:
        return value(self.graph, node, key)

    def send(self, frames: list[Frame]) -> None:
        for frame in frames:
            done = self.value("tracking", "processed")
            self.graph.send([frame])
            self.graph.wait(lambda n=done: self.value("tracking", "processed") > n, f"frame {frame.index}")

    def restart(self, name: str, camera) -> None:
        """Kill a node, and start it again."""
        self.nodes[name].process.kill()
        self.nodes[name].process.wait()
        self.graph.forget(self.nodes[name])
        self.graph.received["/diagnostics"].clear()
        self.nodes[name] = self.graph.start(f"thegra_ros.nodes.{name}")
        self.graph.wait(lambda: self.works(name), f"{name} again")
        if name in ("tracking", "mapping"):
            self.graph.send_camera(camera, listeners=2)

    def end(self) -> list[int]:
        return [node.end() for node in self.nodes.values()]
