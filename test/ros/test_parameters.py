"""The configuration as ROS parameters."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

from pathlib import Path

from rcl_interfaces.msg import ParameterType

from thegra_core.config import PROFILES, Median, load_config
from thegra_core.errors import ConfigError
from thegra_ros.camera_place import frames_of
from thegra_ros.node_config import NodeConfig
from thegra_ros.parameter_table import table
from thegra_ros.parameters import Declared, declared, from_ros


def by_name(profile: str = "quality") -> dict[str, Declared]:
    return {parameter.name: parameter for parameter in declared(load_config(profile))}


@pytest.mark.parametrize("profile", PROFILES)
def test_parameters_hold_the_whole_configuration(profile: str) -> None:
    config = load_config(profile)
    assert from_ros({p.name: p.value for p in declared(config)}, load_config("quality")).model_dump(exclude={"profile"}) == config.model_dump(exclude={"profile"})


def test_every_parameter_has_a_text_and_a_type() -> None:
    types = {ParameterType.PARAMETER_BOOL: bool, ParameterType.PARAMETER_INTEGER: int, ParameterType.PARAMETER_DOUBLE: float, ParameterType.PARAMETER_STRING: str}
    for parameter in [*declared(load_config()), *declared(NodeConfig())]:
        assert parameter.descriptor.description, parameter.name
        assert type(parameter.value) is types[parameter.descriptor.type], parameter.name


def test_ranges_are_those_of_the_model() -> None:
    parameters = by_name()
    keypoints = parameters["extractor.max_keypoints"].descriptor.integer_range[0]
    assert (keypoints.from_value, keypoints.to_value) == (32, 8192)
    angle = parameters["tracking.max_view_angle_deg"].descriptor
    assert (angle.floating_point_range[0].from_value, angle.floating_point_range[0].to_value) == (0.0, 180.0)
    assert angle.additional_constraints == "> 0, < 180"
    seed = parameters["seed"].descriptor.integer_range[0]
    assert seed.from_value == 0 and seed.to_value > 10**9
    assert "superpoint" in parameters["extractor.name"].descriptor.additional_constraints


def test_values_that_may_be_none_and_filters_are_texts() -> None:
    defaults = load_config("fast")
    values = {p.name: p.value for p in declared(defaults)}
    assert values["extractor.nms_radius"] == "none"
    assert from_ros({"extractor.nms_radius": "3"}, defaults).extractor.nms_radius == 3
    assert from_ros({"extractor.device": "none"}, defaults).extractor.device == "none", "a text stays a text"
    assert from_ros({"preprocessing.filters": "he_clip, median"}, defaults).preprocessing.filters[1] == Median()
    assert from_ros({"preprocessing.filters": "[{filter: median, size: 5}]"}, defaults).preprocessing.filters == (Median(size=5),)


@pytest.mark.parametrize(("name", "value"), [("tracking.max_view_angle_deg", 180.0), ("extractor.nms_radius", "many"), ("preprocessing.filters", "sharpen"), ("preprocessing.filters", "[{"), ("weighting", "half")])
def test_what_the_model_refuses_is_named(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
        from_ros({name: value}, load_config())


def test_frames_are_checked() -> None:
    with pytest.raises(ConfigError, match="base_frame"):
        frames_of(NodeConfig(odom_frame="odom"))
    with pytest.raises(ConfigError, match="base_from_camera"):
        frames_of(NodeConfig(base_frame="base_link", base_from_camera='1 2'))
    assert frames_of(NodeConfig(base_frame="base_link")).child == "base_link"


def test_the_parameter_file_that_ships_is_understood() -> None:
    import yaml

    values = yaml.safe_load((Path(__file__).resolve().parents[2] / "config" / "params.yaml").read_text())["/**"]["ros__parameters"]
    known = {p.name for p in [*declared(load_config()), *declared(NodeConfig())]} | {"profile", "config_file", "autostart", "use_sim_time"}
    flat = dict(_flatten(values))
    assert flat and set(flat) - known == set()


def test_the_table_of_parameters_is_that_of_the_model() -> None:
    written = (Path(__file__).resolve().parents[2] / "docs" / "parameters.md").read_text()
    assert written == table(), "renew it: python -m thegra_ros.parameter_table > docs/parameters.md"
    for parameter in [*declared(load_config()), *declared(NodeConfig())]:
        assert f"`{parameter.name}`" in written


def _flatten(values: dict, prefix: str = ""):
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
