"""The table of all parameters, docs/parameters.md: python -m thegra_ros.parameter_table > docs/parameters.md"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from thegra_core.cli.config import Parameter, filter_parameters, parameters
from thegra_core.config import PROFILES, load_config
from thegra_ros.node_config import NodeConfig

_HEAD = """# Parameters

Made by `python -m thegra_ros.parameter_table > docs/parameters.md` from the configuration's model.

Of `thegra run` and the other commands: `--set KEY=VALUE`, or YAML with `--config FILE`. Of the nodes: `-p KEY:=VALUE`, or a parameter file
([config/params.yaml](../config/params.yaml)); numbers that may have a fraction are then written with a point. Where a profile's column is empty it has the
value of `quality`. `thegra run` begins with `quality`, the nodes with `realtime`.

## Of the method
"""
_NODES = """
## Of the nodes, besides

`profile`, `config_file` and `autostart` decide how a node starts. `map_file` may change at any time, the others while the node is not configured.

| parameter | default | takes | meaning |
|---|---|---|---|"""
_FILTERS = """
## Filters

For `preprocessing.filters`: names with commas between them, or a YAML list of `{filter: NAME, PARAMETER: VALUE}`.

| filter, parameter | default | takes | meaning |
|---|---|---|---|"""


def table() -> str:
    """The whole page in Markdown."""
    return "\n".join([_HEAD, *_method(), _NODES, *map(_row, parameters(NodeConfig())), _FILTERS, *map(_row, filter_parameters())]) + "\n"


def _method() -> Iterator[str]:
    by_profile = {name: {p.key: p.value for p in parameters(load_config(name))} for name in PROFILES}
    default = load_config().profile
    others = [name for name in PROFILES if name != default]
    yield f"| parameter | `{default}` | {' | '.join(f'`{name}`' for name in others)} | takes | meaning, unit, source |"
    yield "|---" * (4 + len(others)) + "|"
    for parameter in parameters(load_config()):
        if parameter.key == "profile":
            continue
        value = by_profile[default][parameter.key]
        differing = ("" if by_profile[name][parameter.key] == value else by_profile[name][parameter.key] for name in others)
        yield _cells(f"`{parameter.key}`", value, *differing, parameter.takes, parameter.description)


def _row(parameter: Parameter) -> str:
    name = parameter.key.strip()
    label = f"\N{NO-BREAK SPACE}\N{NO-BREAK SPACE}`{name}`" if parameter.key.startswith(" ") else f"`{name}`"
    return _cells(label, parameter.value, parameter.takes, parameter.description)


def _cells(*texts: str) -> str:
    return "| " + " | ".join(text.replace("|", r"\|").replace("\n", " ") for text in texts) + " |"


if __name__ == "__main__":
    sys.stdout.write(table())
