"""`thegra config`: every parameter with its value, range and source."""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rich.console import Console
from rich.table import Table

from thegra_core.config import Filter, dump_config, load_config

_BOUNDS = (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
_WIDE, _PIPED_WIDTH = 120, 180


@dataclass(frozen=True, slots=True)
class Parameter:
    """One line of the table; `key` is what `--set` takes."""

    key: str
    value: str
    takes: str
    description: str


def config_command(profile: str | None, as_yaml: bool) -> None:
    """Print the configuration of a profile, as a table or as YAML that `--config` reads.

    Raises:
        ConfigError: If there is no such profile.
    """
    config = load_config(profile)
    if as_yaml:
        print(dump_config(config), end="")
        return
    terminal = Console(highlight=False)
    console = terminal if terminal.is_terminal else Console(highlight=False, width=_PIPED_WIDTH)
    table = _wide_table if console.width >= _WIDE else _narrow_table
    console.print(table(f"Parameters of profile {config.profile}; set one with --set KEY=VALUE", list(parameters(config))))
    console.print(table("Filters, for preprocessing.filters: a list of {filter: NAME, PARAMETER: VALUE, ...}", list(filter_parameters())))


def parameters(model: BaseModel, prefix: str = "") -> Iterator[Parameter]:
    """Every parameter of a configuration in order, with its dotted name."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from parameters(value, f"{prefix}{name}.")
        else:
            yield Parameter(f"{prefix}{name}", _value(value), _takes(field), field.description or "")


def filter_parameters() -> Iterator[Parameter]:
    """Every filter with its parameters and their defaults."""
    for kind in typing.get_args(typing.get_args(Filter)[0]):
        name = str(kind.model_fields["filter"].default)
        yield Parameter(name, "", "", (kind.__doc__ or "").strip().splitlines()[0])
        for parameter in parameters(kind()):
            if parameter.key != "filter":
                yield Parameter(f"  {parameter.key}", parameter.value, parameter.takes, parameter.description)


def _wide_table(title: str, rows: list[Parameter]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("parameter", no_wrap=True)
    table.add_column("value", max_width=28)
    table.add_column("takes", max_width=28)
    table.add_column("meaning, unit, source", ratio=1)
    for row in rows:
        table.add_row(row.key, row.value, row.takes, row.description)
    return table


def _narrow_table(title: str, rows: list[Parameter]) -> Table:
    table = Table(title=title, title_justify="left", show_lines=True)
    table.add_column("parameter", overflow="fold")
    table.add_column("value (takes); meaning, unit, source", ratio=1)
    for row in rows:
        takes = f"{row.value} ({row.takes})" if row.takes else row.value
        table.add_row(row.key, "\n".join(part for part in (takes, row.description) if part))
    return table


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(str(getattr(item, "filter", item)) for item in value) or "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return {None: "none", True: "true", False: "false"}[value] if value is None or isinstance(value, bool) else str(value)


def _takes(field: FieldInfo) -> str:
    bounds = [f"{sign} {_value(getattr(item, name))}" for item in field.metadata for name, sign in _BOUNDS if getattr(item, name, None) is not None]
    return " ".join([_type_name(field.annotation), *bounds])


def _type_name(annotation: Any) -> str:
    origin = typing.get_origin(annotation)
    if origin is Literal:
        return " | ".join(str(item) for item in typing.get_args(annotation))
    if origin in (types.UnionType, typing.Union):
        return " | ".join(_type_name(item) for item in typing.get_args(annotation))
    if origin is tuple:
        return "list"
    return {int: "integer", float: "number", bool: "true | false", str: "text", type(None): "none"}.get(annotation, str(annotation))
