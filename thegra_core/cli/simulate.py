"""`thegra simulate`: a thermal recording with exact ground truth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from pydantic import ValidationError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from thegra_core.errors import ConfigError
from thegra_core.simulation.simulate import Format, SimulationOptions, simulate

_SIZE = re.compile(r"(\d+)[xX](\d+)")


def simulate_command(values: dict[str, Any], size: str | None, assignments: Sequence[str], format_name: str, out: Path, quiet: bool) -> None:
    """Simulate, with a bar on stderr, and name what `thegra run` takes.

    Args:
        values: Fields of `SimulationOptions` that were given; None means not given.
        assignments: KEY=VALUE of `SensorConfig`.

    Raises:
        ThegraError: If an option cannot be used; see `simulate.simulate`.
    """
    options = _options(values, size, assignments)
    with Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=30), MofNCompleteColumn(), TimeRemainingColumn(compact=True), console=Console(stderr=True), transient=True, disable=quiet
    ) as bar:
        task = bar.add_task(f"simulating {options.scene if options.source is None else options.source}", total=None)
        made = simulate(options, out, cast(Format, format_name), lambda done, total: bar.update(task, completed=done, total=total))
    console = Console(highlight=False)
    console.print(f"recording  {made}\nrun it     thegra run {made}", soft_wrap=True, markup=False)


def image_size(text: str) -> tuple[int, int]:
    """(width, height) of a `--size`.

    Raises:
        ConfigError: If it is not WIDTHxHEIGHT.
    """
    match = _SIZE.fullmatch(text)
    if match is None:
        raise ConfigError(f"--size {text}: write WIDTHxHEIGHT, e.g. --size 640x512")
    return int(match[1]), int(match[2])


def _options(values: dict[str, Any], size: str | None, assignments: Sequence[str]) -> SimulationOptions:
    given = {key: value for key, value in values.items() if value is not None}
    if size is not None:
        given["image_size"] = image_size(size)
    sensor: dict[str, str] = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {assignment}: write KEY=VALUE, e.g. --set netd_mk=40; docs/simulator.md lists the keys")
        sensor[key.strip().removeprefix("sensor.")] = value
    try:
        return SimulationOptions(**given, sensor=sensor)
    except ValidationError as error:
        lines = [f"  {'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()]
        raise ConfigError("options not understood:\n" + "\n".join(lines) + "\nsee: thegra simulate --help, and docs/simulator.md for the sensor's parameters") from error
