"""Commands that other packages add: functions for typer under the entry point groups `thegra.commands` and, for `thegra benchmark`, `thegra.benchmarks`."""

from __future__ import annotations

from importlib.metadata import entry_points

import typer

COMMANDS = "thegra.commands"
BENCHMARKS = "thegra.benchmarks"
PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Arguments that such a command does not know reach it in `typer.Context.args`."""


def add_commands(app: typer.Typer, group: str = COMMANDS) -> None:
    """Add every command of the group; the name is the entry point's."""
    for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
        app.command(name=entry.name, context_settings=PASS_ON)(entry.load())
