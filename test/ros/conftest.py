"""ROS 2 for tests: a graph of one's own, and a recording to play in it."""

from __future__ import annotations

import importlib.util
import itertools
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from thegra_core.messages import Frame
from thegra_core.simulation.cameras import thermal_camera
from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.simulation.simulate import SimulationOptions, simulate
from thegra_core.sources.open import open_recording

if TYPE_CHECKING:
    from ros_graph import Graph

    from thegra_core.geometry.camera import CameraModel

if importlib.util.find_spec("rclpy") is not None:
    with warnings.catch_warnings():  # its parser imports a module that Python has deprecated
        warnings.simplefilter("ignore", DeprecationWarning)
        import rosidl_generator_py  # noqa: F401

SIZE = (320, 256)
_domains = itertools.count(os.getpid())


@pytest.fixture(scope="session")
def recording_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = SimulationOptions(scene="room", style="aggressive", duration_s=4.0, rate_hz=10.0, image_size=SIZE, sensor=SensorConfig(netd_mk=15))  # easy: the tests use ORB
    return simulate(options, tmp_path_factory.mktemp("demo") / "bag")


@pytest.fixture(scope="session")
def frames(recording_path: Path) -> list[Frame]:
    return list(open_recording(recording_path).frames())


@pytest.fixture(scope="session")
def camera() -> CameraModel:
    return thermal_camera(SIZE)


@pytest.fixture
def graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    from ros_graph import Graph

    domain = 1 + next(_domains) % 100  # beyond 101 the ports meet those that Linux gives away
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    made = Graph(domain, tmp_path)
    yield made
    made.close()
