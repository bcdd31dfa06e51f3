"""Whether places are told apart and found again: joined recordings, and cameras that are set down somewhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thegra_core.errors import ConfigError
from thegra_core.evaluation.benchmark import joining, kidnapping
from thegra_core.evaluation.benchmark.machine import described, machine
from thegra_core.evaluation.benchmark.settings import Settings
from thegra_core.evaluation.benchmark.slam import Plan as Folder
from thegra_core.evaluation.benchmark.slam import write_report
from thegra_core.sources.joined import Clip
from thegra_core.version import VERSION

KIDNAPPED = "kidnapped"
CHECKS = (*joining.KINDS, KIDNAPPED)
USUAL = tuple(name for name in CHECKS if name != "turned")
"""A camera that turns round is one that looks at the ground, and asks for `loop.rotations`."""
HEADER = ("joined", "frames", "tracked %", "maps", "losses", "relocalizations", "loops", "merges", "false poses", "found again %", "apart", "verdict")
MIN_FOUND = 0.9
"""Share of the trials in which a kidnapped camera must be found."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What to check. gap_s: seconds without a frame between joined clips; trials: of kidnapping in each map; shown: frames
    of each other recording that it is shown; assignments: told in the results."""

    checks: tuple[str, ...] = USUAL
    gap_s: float = 0.0
    trials: int = 20
    shown: int = 20
    assignments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        unknown = next((name for name in self.checks if name not in CHECKS), None)
        if unknown is not None:
            raise ConfigError(f"--check {unknown}: choose of {', '.join(CHECKS)}")


def benchmark(clips: Mapping[str, Clip], plan: Plan, settings: Settings, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Make every check and write `results.json` and `results.md`; returns what the former holds.

    Raises:
        InputError: If a result cannot be written.
    """
    content: dict[str, Any] = {
        "version": VERSION, "machine": machine(), "profile": settings.config.profile, "assignments": list(plan.assignments), "gap_s": plan.gap_s,
        "frames": {name: len(clip.frames) for name, clip in clips.items()}, "joined": [], "kidnapped": [],
    }  # fmt: skip
    for which in joining.planned(list(clips), plan.checks):
        say(joining.title(which))
        content["joined"].append(joining.run_one(clips, which, plan.gap_s, settings))
        write_report(Folder((), out), content, markdown(content))
    if KIDNAPPED in plan.checks:
        for told in kidnapping.benchmark(list(clips.values()), plan.trials, plan.shown, settings, say):
            content["kidnapped"].append(told)
            write_report(Folder((), out), content, markdown(content))
    return content


def wrong(content: Mapping[str, Any]) -> list[str]:
    """One line for each place that was taken for another one, or not found again."""
    told = [f"{' + '.join(r['parts'])}: {r['verdict']}" for r in content["joined"] if r["verdict"].startswith("wrong")]
    for result in content["kidnapped"]:
        if result["found"] is None:
            told.append(f"no map of {result['map']}")
            continue
        trials = result["found"] + result["elsewhere"] + result["lost"]
        if result["elsewhere"] or result["found"] < MIN_FOUND * trials:
            told.append(f"kidnapped in {result['map']}: found {result['found']} of {trials} times, elsewhere {result['elsewhere']} times")
        told += [f"{name} in the map of {result['map']}: {len(claims)} poses" for name, claims in result["claims"].items() if claims]
    return told


def markdown(content: Mapping[str, Any]) -> str:
    """GitHub tables, and what their columns mean."""
    settings = f", with {', '.join(content['assignments'])}" if content["assignments"] else ""
    frames = sorted(set(content["frames"].values()))
    told = [f"Profile {content['profile']}{settings}; {frames[0]} to {frames[-1]} frames a recording. Thegra {content['version']}, {described(content['machine'])}."]
    if content["joined"]:
        gap = f" {content['gap_s']:g} s without a frame between clips." if content["gap_s"] else ""
        explained = (
            f"Tracked: of each clip. False poses: in a map of another scene. Found again: images of a way back that are in the map of the way there; apart: median "
            f"distance to where the same image was before, over the extent of the clip's way.{gap}"
        )
        told = [_table(HEADER, [_row(r) for r in content["joined"]]), explained, *told]
    if content["kidnapped"]:
        names = list(content["frames"])
        rows = [(r["map"], *(_kidnapped(r, name) for name in names)) for r in content["kidnapped"]]
        explained = (
            "A map of every other frame, one a row, and the camera set down at unseen frames of the same recording: found / trials. Frames of other recordings, in a "
            "column each: poses claimed in it."
        )
        told = [_table(("map", *names), rows), explained, *told]
    return "\n\n".join([*told, *(f"Wrong: {line}" for line in wrong(content))]) + "\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *rows])


def _kidnapped(result: Mapping[str, Any], name: str) -> str:
    if result["found"] is None:
        return "–"
    if name != result["map"]:
        return str(len(result["claims"][name]))
    elsewhere = f", {result['elsewhere']} elsewhere" if result["elsewhere"] else ""
    return f"{result['found']} / {result['found'] + result['elsewhere'] + result['lost']}{elsewhere}"


def _row(result: Mapping[str, Any]) -> tuple[str, ...]:
    counted = (str(result[key]) for key in ("maps", "losses", "relocalizations", "loops", "merges", "false_poses"))
    again = "–" if result["found_again_pct"] is None else f"{result['found_again_pct']:.1f}"
    apart = "–" if result["apart"] is None else f"{100 * result['apart']:.1f} %"
    tracked = " / ".join(f"{pct:.0f}" for pct in result["tracked_pct"])
    return (" + ".join(result["parts"]), str(result["frames"]), tracked, *counted, again, apart, result["verdict"])
