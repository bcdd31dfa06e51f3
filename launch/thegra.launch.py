"""Starts Thegra: ros2 launch thegra_ros thegra.launch.py image:=/camera/image_raw

`ros2 launch thegra_ros thegra.launch.py --show-args` lists the arguments.
"""

import os
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity

PACKAGE = "thegra_ros"
STAGES = ("preprocessing", "frontend", "tracking", "mapping")
ARGUMENTS = {
    "namespace": ("thegra", "namespace of nodes and topics"),
    "image": ("", "the camera's image topic; empty: image_raw in the namespace"),
    "camera_info": ("", "the camera's camera_info topic; empty: beside the image topic"),
    "image_transport": ("", "raw, or compressed: images are on compressed below the image topic; empty: what params_file says"),
    "params_file": ("", "YAML with parameters; empty: the one that ships with the package"),
    "profile": ("", "paper, quality, fast or realtime; empty: what params_file says, else realtime"),
    "camera_file": ("", "calibration file; wins over camera_info; empty: what params_file says"),
    "base_frame": ("", "robot frame whose pose is published; empty: what params_file says"),
    "odom_frame": ("", "odometry frame, if there is one; empty: what params_file says"),
    "single_process": ("true", "true: one node, slam; false: the four stages as nodes of their own"),
    "use_sim_time": ("false", "take the time from /clock, as when a bag is played"),
    "autostart": ("true", "configure and activate the nodes"),
    "play": ("", "recording to play instead of a camera, whatever `thegra play` takes; with use_sim_time its time is on /clock"),
    "rate": ("1.0", "times as fast as recorded"),
    "log_level": ("info", "debug, info, warn or error"),
    "rviz": ("false", "start RViz with a view of it"),
}


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    declared = [DeclareLaunchArgument(name, default_value=default, description=text) for name, (default, text) in ARGUMENTS.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])


def actions(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The nodes, once the arguments are known."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    config = Path(get_package_share_directory(PACKAGE)) / "config"
    names = ("slam",) if is_true(given["single_process"]) else STAGES
    result: list[LaunchDescriptionEntity] = []
    if "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ:
        result.append(SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", str(config / "fastdds.xml")))
    result += [
        LifecycleNode(
            package=PACKAGE, executable=name, name=name, namespace=given["namespace"], output="screen", emulate_tty=True,
            parameters=[given["params_file"] or str(config / "params.yaml"), parameters(given)], remappings=remappings(given),
            arguments=["--ros-args", "--log-level", f"{given['namespace'].strip('/').replace('/', '.')}.{name}:={given['log_level']}".lstrip(".")],
        )
        for name in names
    ]
    if given["play"]:
        result.append(Node(package=PACKAGE, executable="thegra", arguments=play_arguments(given), remappings=remappings(given), output="screen"))
    if is_true(given["rviz"]):
        result.append(Node(package="rviz2", executable="rviz2", name="rviz", arguments=["-d", str(config / "thegra.rviz")], output="screen"))
    return result


def play_arguments(given: dict[str, str]) -> list[str]:
    """The command line of `thegra play`."""
    arguments = ["play", given["play"], "--rate", given["rate"], "--namespace", given["namespace"]]
    return [*arguments, "--clock"] if is_true(given["use_sim_time"]) else arguments


def parameters(given: dict[str, str]) -> dict[str, object]:
    """Parameters that the arguments give; what is empty is left to the file."""
    texts = {name: given[name] for name in ("profile", "camera_file", "image_transport", "base_frame", "odom_frame") if given[name]}
    return {**texts, "use_sim_time": is_true(given["use_sim_time"]), "autostart": is_true(given["autostart"])}


def remappings(given: dict[str, str]) -> list[tuple[str, str]]:
    """The camera's topics; its camera_info stands beside the image unless it is named."""
    image, info = given["image"], given["camera_info"]
    if image and not info:
        info = f"{image.rpartition('/')[0]}/camera_info"
    return [(mine, theirs) for mine, theirs in (("image_raw", image), ("image_raw/compressed", f"{image}/compressed" if image else ""), ("camera_info", info)) if theirs]


def is_true(text: str) -> bool:
    """Whether an argument says yes."""
    return text.strip().lower() in ("true", "1", "yes", "on")
