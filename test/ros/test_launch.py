"""The launch file, the layouts, and what is installed for `ros2 run`. launch itself is no Python package: a recorder stands for it."""

from __future__ import annotations

import importlib.util
import json
import sys
import types
import xml.etree.ElementTree as ElementTree
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from thegra_core.cli.extensions import PASS_ON
from thegra_ros import commands

ROOT = Path(__file__).resolve().parents[2]


class Recorded:
    """An action: its arguments by name."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


class Configuration(Recorded):
    def perform(self, context: dict[str, str]) -> str:
        return context[self.args[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> Any:
    def module(name: str, **contents: Any) -> None:
        made = types.ModuleType(name)
        made.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, made)

    def kind(name: str) -> type:
        return type(name, (Recorded,), {})

    module("launch", LaunchDescription=kind("LaunchDescription"), LaunchContext=dict, LaunchDescriptionEntity=object)
    module("launch.actions", **{name: kind(name) for name in ("DeclareLaunchArgument", "OpaqueFunction", "SetEnvironmentVariable")})
    module("launch.substitutions", LaunchConfiguration=Configuration)
    module("launch_ros")
    module("launch_ros.actions", LifecycleNode=kind("LifecycleNode"), Node=kind("Node"))
    module("ament_index_python")
    module("ament_index_python.packages", get_package_share_directory=lambda name: str(ROOT))
    spec = importlib.util.spec_from_file_location("thegra_launch", ROOT / "launch" / "thegra.launch.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def run(launch_file: Any, **given: str) -> list[Recorded]:
    """The actions of a launch with those arguments, defaults from the declarations."""
    description = launch_file.generate_launch_description().args[0]
    declared = {entity.args[0]: entity.kwargs["default_value"] for entity in description if type(entity).__name__ == "DeclareLaunchArgument"}
    assert set(given) <= set(declared)
    return description[-1].kwargs["function"]({**declared, **given})


def test_one_node_by_default(launch_file: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    environment, node = run(launch_file)
    name, file = environment.args
    assert name == "FASTRTPS_DEFAULT_PROFILES_FILE" and Path(file).is_file()
    assert node.kwargs["executable"] == "slam" and node.kwargs["namespace"] == "thegra"
    assert Path(node.kwargs["parameters"][0]).is_file() and node.kwargs["remappings"] == []
    assert node.kwargs["parameters"][1] == {"use_sim_time": False, "autostart": True}, "what is not given is left to the file"


def test_arguments_reach_the_nodes(launch_file: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "mine.xml")
    of_camera = {"image": "/boson/image_raw", "image_transport": "compressed"}
    *nodes, rviz = run(launch_file, single_process="false", **of_camera, profile="fast", use_sim_time="true", rviz="true", base_frame="base_link")
    assert [n.kwargs["executable"] for n in nodes] == list(launch_file.STAGES), "the user's own profile of Fast DDS stays"
    for node in nodes:
        assert dict(node.kwargs["remappings"]) == {"image_raw": "/boson/image_raw", "image_raw/compressed": "/boson/image_raw/compressed", "camera_info": "/boson/camera_info"}
        assert node.kwargs["parameters"][1] == {
            "profile": "fast", "image_transport": "compressed", "base_frame": "base_link", "use_sim_time": True, "autostart": True,
        }  # fmt: skip
    assert Path(rviz.kwargs["arguments"][1]).is_file()


def test_a_recording_is_played_to_the_nodes(launch_file: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line has to be one that `thegra play` takes, with what launch adds for ROS behind it."""
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "mine.xml")
    node, play = run(launch_file, play="/data/flight.mcap", rate="0.5", namespace="robot", use_sim_time="true")
    assert node.kwargs["namespace"] == "robot" and node.kwargs["parameters"][1]["use_sim_time"]
    command, *arguments = play.kwargs["arguments"]
    assert (play.kwargs["executable"], command) == ("thegra", "play") and "thegra" in {entry.name for entry in entry_points(group="console_scripts")}
    taken: list[Any] = []
    monkeypatch.setattr("thegra_ros.play.play", taken.append)
    monkeypatch.setattr("thegra_ros.commands.need_ros", lambda name: None)
    app = typer.Typer()
    app.command(context_settings=PASS_ON)(commands.play)
    app([*arguments, "--ros-args", "-r", "image_raw:=/boson/image_raw"], standalone_mode=False)
    (options,) = taken
    assert (str(options.recording), options.rate, options.namespace, options.clock) == ("/data/flight.mcap", 0.5, "robot", True)
    assert options.extra == ("--ros-args", "-r", "image_raw:=/boson/image_raw")


def test_executables_of_the_launch_file_are_installed(launch_file: Any) -> None:
    scripts = {entry.name: entry for entry in entry_points(group="console_scripts") if entry.value.startswith("thegra_ros.nodes.")}
    assert {"slam", *launch_file.STAGES} == set(scripts)


def test_layouts_show_topics_that_exist() -> None:
    topics = {"/thegra/map_points", "/thegra/path", "/thegra/keyframe_path", "/thegra/odometry", "/thegra/image_tracks"}
    rviz = yaml.safe_load((ROOT / "config" / "thegra.rviz").read_text())
    shown = [display["Topic"] for display in rviz["Visualization Manager"]["Displays"] if "Topic" in display]
    assert {topic["Value"] for topic in shown} == topics
    latched = {topic["Value"] for topic in shown if topic["Durability Policy"] == "Transient Local"}
    assert latched == {"/thegra/map_points", "/thegra/path", "/thegra/keyframe_path"}
    foxglove = json.loads((ROOT / "config" / "thegra_foxglove.json").read_text())
    assert set(foxglove["configById"]["3D!map"]["topics"]) <= topics | {"/thegra/pose"}
    assert foxglove["configById"]["Image!tracks"]["imageMode"]["imageTopic"] in topics


def test_the_profile_of_fast_dds_holds_an_image() -> None:
    name = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"
    root = ElementTree.parse(ROOT / "config" / "fastdds.xml").getroot()
    shared = next(d for d in root.iter(f"{name}transport_descriptor") if d.findtext(f"{name}type") == "SHM")
    assert int(shared.findtext(f"{name}segment_size") or 0) > 2 * 640 * 512 * 2
    assert {t.text for t in root.iter(f"{name}transport_id")} == {"large_segments", "large_buffers"}
