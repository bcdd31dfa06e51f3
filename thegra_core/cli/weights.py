"""`thegra weights`: see, fetch and check the networks' weights."""

from __future__ import annotations

import json
import os
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn
from rich.table import Table

from thegra_core.config import PROFILES, load_config
from thegra_core.features.download import fetch
from thegra_core.features.registry import weights_for
from thegra_core.features.weights import ACCEPT_VARIABLE, WeightStatus, cache_dir, verify, weight_named

app = typer.Typer(no_args_is_help=True, help="The networks' weights: what there is, under which licence, and fetching them.")
_STYLES = {"ok": "green", "missing": "yellow", "damaged": "red"}
JsonOption = Annotated[bool, typer.Option("--json", help="machine-readable output")]


@app.command("list")
def list_weights(as_json: JsonOption = False) -> None:
    """Show all weights with licence, size and whether they are here. Example: thegra weights list --json"""
    _show(verify(), as_json)


@app.command("fetch")
def fetch_weights(
    names: Annotated[list[str] | None, typer.Argument(help="names from `thegra weights list`; none: those of the profile")] = None,
    profile: Annotated[str, typer.Option(help=f"whose weights to fetch when no name is given: {', '.join(PROFILES)}")] = "quality",
    accept_licence: Annotated[bool, typer.Option("--accept-licence", help="accept restrictive licences (SuperPoint: non-commercial research)")] = False,
) -> None:
    """Download weights into the cache and check them. Example: thegra weights fetch --profile fast"""
    console = Console(stderr=True)
    config = load_config(profile)
    chosen = names or list(weights_for(config.extractor, config.matcher))
    accepted = accept_licence or _accepted_by_user(chosen, console)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with Progress(*columns, console=console) as bars:
        tasks = {name: bars.add_task(name, total=weight_named(name).size) for name in chosen}
        fetch(chosen, lambda name, done, total: bars.update(tasks[name], completed=done, total=total), console.log, accept=accepted)
        for name, task in tasks.items():
            bars.update(task, completed=weight_named(name).size)
    console.print(f"{len(chosen)} files checked and ready in {cache_dir()}")


@app.command("verify")
def verify_weights(as_json: JsonOption = False) -> None:
    """Check the cached files against the manifest; exit code 2 if one is damaged. Example: thegra weights verify"""
    statuses = verify()
    _show(statuses, as_json)
    if any(status.state == "damaged" for status in statuses):
        damaged = [status.weight.name for status in statuses if status.state == "damaged"]
        Console(stderr=True).print(f"damaged: {', '.join(damaged)}; get them again with: thegra weights fetch {' '.join(damaged)}")
        raise typer.Exit(2)


def _accepted_by_user(names: list[str], console: Console) -> bool:
    """Ask about each restrictive licence whose file is not here yet, if there is somebody to ask."""
    restricted = [status.weight for status in verify(names) if status.weight.restricted and status.state != "ok"]
    if not restricted or os.environ.get(ACCEPT_VARIABLE) == "1" or not console.is_interactive:
        return False
    for weight in restricted:
        console.print(f"[bold]{weight.name}[/bold]: {weight.licence}. {weight.note}")
    return typer.confirm("Do you accept?", err=True)


def _show(statuses: list[WeightStatus], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"cache": str(cache_dir()), "weights": [_as_dict(status) for status in statuses]}, indent=2))
        return
    table = Table(title=f"Weights in {cache_dir()}", title_justify="left")
    for column in ("name", "size", "state", "licence", "note"):
        table.add_column(column, no_wrap=column in ("name", "state"))
    for status in statuses:
        weight = status.weight
        state = f"[{_STYLES[status.state]}]{status.state}[/]"
        table.add_row(weight.name, f"{weight.size / 1e6:.1f} MB", state, f"[bold]{weight.licence}[/]" if weight.restricted else weight.licence, weight.note)
    Console().print(table)


def _as_dict(status: WeightStatus) -> dict[str, object]:
    weight = status.weight
    return {
        "name": weight.name, "state": status.state, "path": str(status.path), "size": weight.size, "sha256": weight.sha256, "licence": weight.licence,
        "restricted": weight.restricted, "note": weight.note, "url": weight.url, "second_source": f"{weight.wheel.requirement}:{weight.member}",
    }
