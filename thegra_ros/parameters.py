"""The configuration model as ROS parameters: dotted names, ranges, units and texts come from the model.

A list is one parameter of YAML text. Parameters that may be none are texts: `none` or a number.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from thegra_core.config import ThegraConfig, load_config
from thegra_core.errors import ConfigError

_TYPES = {bool: ParameterType.PARAMETER_BOOL, int: ParameterType.PARAMETER_INTEGER, float: ParameterType.PARAMETER_DOUBLE, str: ParameterType.PARAMETER_STRING}
_NAMES = {ParameterType.PARAMETER_BOOL: "true or false", ParameterType.PARAMETER_INTEGER: "a whole number", ParameterType.PARAMETER_DOUBLE: "a number with a point, as in 1.0",
          ParameterType.PARAMETER_STRING: "a text in quotes"}  # fmt: skip
_LARGEST = 2**63 - 1
ModelT = typing.TypeVar("ModelT", bound=BaseModel)
LIVE_PROFILE = "realtime"
"""The one that keeps up with a camera on a small computer."""
FIXED = ("profile", "config_file")
"""Parameters that decide the defaults of the others: they are given when the node starts and cannot change."""


@dataclass(frozen=True, slots=True)
class Declared:
    """A field of the model as a ROS parameter."""

    name: str
    value: Any
    descriptor: ParameterDescriptor


def declared(model: BaseModel, prefix: str = "") -> Iterator[Declared]:
    """Every field of a model, with the model's values as defaults."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from declared(value, f"{prefix}{name}.")
        elif f"{prefix}{name}" != "profile":  # the node's own
            yield Declared(f"{prefix}{name}", to_ros(value), descriptor(field))


def to_ros(value: Any) -> Any:
    """A field's value as ROS holds it."""
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return yaml.safe_dump([item.model_dump(mode="json") if isinstance(item, BaseModel) else item for item in value], default_flow_style=True, width=10**6, sort_keys=False).strip()
    return value


def from_ros(values: Mapping[str, Any], defaults: ThegraConfig) -> ThegraConfig:
    """The configuration that parameters describe.

    Raises:
        ConfigError: Naming the parameter and what it takes.
    """
    tree = defaults.model_dump(mode="python")
    for name, value in values.items():
        *sections, last = name.split(".")
        node = tree
        for section in sections:
            node = node[section]
        listed = isinstance(node[last], tuple | list)
        node[last] = _items(name, value) if listed else None if value == "none" and not isinstance(node[last], str) else value
    return validated(ThegraConfig, tree)


def validated(model: type[ModelT], values: Mapping[str, Any]) -> ModelT:
    """The model of those values.

    Raises:
        ConfigError: Naming each value that is refused.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        lines = [f"{'.'.join(str(part) for part in e['loc'])}: {e['msg']} (got {e['input']!r})" for e in error.errors()]
        raise ConfigError("; ".join(lines)) from error


def descriptor(field: FieldInfo) -> ParameterDescriptor:
    """Type, range and text of a field."""
    kind = _kind(field)
    low, high, exclusive = _bounds(field)
    result = ParameterDescriptor(type=kind, description=field.description or "", additional_constraints=_constraints(field, exclusive))
    if kind == ParameterType.PARAMETER_INTEGER and (low is not None or high is not None):
        result.integer_range = [IntegerRange(from_value=math.ceil(low) if low is not None else -_LARGEST, to_value=math.floor(high) if high is not None else _LARGEST, step=0)]
    elif kind == ParameterType.PARAMETER_DOUBLE and (low is not None or high is not None):
        result.floating_point_range = [FloatingPointRange(from_value=low if low is not None else -1e300, to_value=high if high is not None else 1e300, step=0.0)]
    return result


def declare(node: Node, parameters: typing.Iterable[Declared]) -> dict[str, Any]:
    """Declare parameters; their values, overrides applied.

    Raises:
        ConfigError: If an override has the wrong type or lies outside of the range.
    """
    values: dict[str, Any] = {}
    for parameter in parameters:
        try:
            values[parameter.name] = node.declare_parameter(parameter.name, parameter.value, parameter.descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            given = node._parameter_overrides.get(parameter.name)  # rclpy offers no other way to what was given
            wanted = _NAMES[parameter.descriptor.type]
            raise ConfigError(f"parameter {parameter.name} is given as {given.value if given else '?'} and takes {wanted} ({parameter.descriptor.description}): {error}") from error
    return values


def load_defaults(node: Node) -> ThegraConfig:
    """Declare `profile` and `config_file` and load what they name: the defaults of all other parameters.

    Raises:
        ConfigError: If a file or profile cannot be used.
    """
    own = {
        "profile": ("", f"paper, quality, fast or realtime; empty: what config_file names, else {LIVE_PROFILE}"),
        "config_file": ("", "YAML with parameters as `thegra run --config` takes it; other parameters win over it"),
    }
    values = declare(node, (Declared(n, v, ParameterDescriptor(type=ParameterType.PARAMETER_STRING, description=text, read_only=True)) for n, (v, text) in own.items()))
    return load_config(values["profile"] or None, Path(values["config_file"]).expanduser() if values["config_file"] else None, default=LIVE_PROFILE)


def _items(name: str, text: str) -> tuple[Any, ...]:
    """A YAML list, or its items alone with commas between them; of filters their names will do."""
    try:
        values = yaml.safe_load(text)
        if isinstance(values, str):
            values = [yaml.safe_load(part) for part in values.split(",")]
    except yaml.YAMLError as error:
        raise ConfigError(f"{name} is no YAML: {error}") from error
    items = values if isinstance(values, list) else [] if values is None else [values]
    return tuple({"filter": item} if name == "preprocessing.filters" and isinstance(item, str) else item for item in items)


def _kind(field: FieldInfo) -> int:
    annotation, origin = field.annotation, typing.get_origin(field.annotation)
    if origin is Literal:
        return ParameterType.PARAMETER_STRING if isinstance(typing.get_args(annotation)[0], str) else ParameterType.PARAMETER_INTEGER
    return _TYPES[annotation] if isinstance(annotation, type) and annotation in _TYPES else ParameterType.PARAMETER_STRING


def _bounds(field: FieldInfo) -> tuple[float | None, float | None, list[str]]:
    """Inclusive limits, as ROS has them; exclusive ones in words besides."""
    low = high = None
    exclusive: list[str] = []
    for item in field.metadata:
        for attribute, sign in (("ge", ""), ("gt", ">"), ("le", ""), ("lt", "<")):
            limit = getattr(item, attribute, None)
            if limit is None:
                continue
            low, high = (float(limit), high) if attribute[0] == "g" else (low, float(limit))
            if sign:
                exclusive.append(f"{sign} {limit:g}")
    if field.annotation is int and any(text.startswith(">") for text in exclusive) and low is not None:
        low, exclusive = low + 1, []
    return low, high, exclusive


def _constraints(field: FieldInfo, exclusive: list[str]) -> str:
    annotation, origin = field.annotation, typing.get_origin(field.annotation)
    if origin is Literal:
        return "one of: " + ", ".join(str(item) for item in typing.get_args(annotation))
    if origin in (types.UnionType, typing.Union):
        return "a number or none"
    if origin is tuple:
        of_filters = typing.get_origin(typing.get_args(annotation)[0]) is not Literal
        return "names with commas, or a YAML list of {filter: NAME, PARAMETER: VALUE, ...}" if of_filters else "a YAML list, or its items with commas"
    return ", ".join(exclusive)
