"""A recording played over and over into the node: does memory grow, does anything pile up, does each turn begin a new map?"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor

from thegra_core.config import ThegraConfig
from thegra_core.errors import InputError
from thegra_core.evaluation.benchmark.memory import resident_mb
from thegra_ros.benchmark.latency import GRAPHS
from thegra_ros.benchmark.processes import NAMESPACE, end, running
from thegra_ros.qos import RELIABLE

SAMPLE_S = 1.0
MOST_GROWTH_PCT = 5.0


@dataclass(frozen=True, slots=True)
class Sample:
    """Seconds since the beginning; MB of all nodes with their processes; images received and dropped so far; the state now."""

    time_s: float
    memory_mb: float
    images: int
    dropped: int
    state: str


@dataclass(frozen=True, slots=True)
class Plan:
    """How long; how much of that, at the beginning, does not count; frames a second as played and as recorded; and into which graph."""

    minutes: float
    warm_up_s: float
    rate_hz: float
    recorded_hz: float
    graph: str


def soak(recording: Path, config: ThegraConfig, plan: Plan, say: Callable[[str], None]) -> dict[str, Any]:
    """Play for so long; what became of memory.

    Raises:
        InputError: If a node or the player ended.
    """
    samples: list[Sample] = []
    play = [sys.executable, "-m", "thegra_core.cli.main", "play", str(recording), "--loop", "--rate", f"{plan.rate_hz / plan.recorded_hz:.6g}", "--namespace", NAMESPACE, "--wait", "60"]
    with running(GRAPHS[plan.graph], config) as nodes, _listener() as facts, _process(play) as player:
        begin = time.monotonic()
        while (now := time.monotonic() - begin) < 60 * plan.minutes:
            facts.spin(SAMPLE_S)
            ended = next((p for p in (*nodes, player) if p.poll() is not None), None)
            if ended is not None:
                raise InputError(f"a process has ended with {ended.returncode} after {now:.0f} s")
            samples.append(Sample(round(now, 1), round(sum(resident_mb(p.pid) for p in nodes), 1), facts.count("images"), facts.count("dropped"), facts.state))
            say(f"{now:.0f} s, {samples[-1].memory_mb:.0f} MB")
    return summary(samples, plan)


def summary(samples: list[Sample], plan: Plan) -> dict[str, Any]:
    """Growth of memory after the warm-up: of the line through what follows, over its own beginning, per cent."""
    warm = [s for s in samples if s.time_s >= plan.warm_up_s]
    times, memory = np.array([s.time_s for s in warm]), np.array([s.memory_mb for s in warm])
    slope, start = np.polyfit(times - times[0], memory, 1)
    growth = 100.0 * slope * (times[-1] - times[0]) / start
    return {
        "graph": plan.graph, "minutes": plan.minutes, "warm_up_s": plan.warm_up_s, "rate_hz": plan.rate_hz, "images": samples[-1].images, "dropped": samples[-1].dropped,
        "tracking_pct": round(100.0 * sum(s.state == "tracking" for s in warm) / len(warm), 1), "warm_mb": round(float(start), 1),
        "peak_mb": max(s.memory_mb for s in samples), "growth_pct": round(float(growth), 2), "most_growth_pct": MOST_GROWTH_PCT,
        "samples": [asdict(s) for s in samples],
    }  # fmt: skip


class _Facts:
    """What the nodes last said on /diagnostics."""

    def __init__(self) -> None:
        self._node = rclpy.create_node("soak", namespace=NAMESPACE)
        self._values: dict[str, dict[str, str]] = {}
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_message, RELIABLE)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)

    def spin(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (rest := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=rest)

    def count(self, key: str) -> int:
        """The largest count that a node tells."""
        return max((int(values.get(key, "0")) for values in self._values.values()), default=0)

    @property
    def state(self) -> str:
        return next((values["state"] for values in self._values.values() if "state" in values), "")

    def _on_message(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._values[status.name] = {value.key: value.value for value in status.values}


@contextmanager
def _listener() -> Any:
    rclpy.init(args=[])
    try:
        yield _Facts()
    finally:
        rclpy.try_shutdown()


@contextmanager
def _process(command: list[str]) -> Any:
    process = subprocess.Popen(command)
    try:
        yield process
    finally:
        end([process])
