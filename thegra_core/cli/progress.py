"""What `thegra run` shows: a progress bar while it runs, a table when it is done."""

from __future__ import annotations

import logging
import re
import time
from typing import Any, Protocol

from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.table import Table

from thegra_core.messages import TrackingResult, TrackingState
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT
from thegra_core.outputs.viewer import Scene
from thegra_core.outputs.write import WrittenRun

_COLOURS = {
    TrackingState.TRACKING: "green",
    TrackingState.HOLD: "cyan",
    TrackingState.LOST: "red",
    TrackingState.RELOCALIZING: "red",
    TrackingState.INITIALIZING: "yellow",
    TrackingState.WAITING: "yellow",
}


class News:
    """Tells which results are worth a line: those that change the state, and in it each reason once, whatever its figures."""

    def __init__(self) -> None:
        self._state: TrackingState | None = None
        self._said: set[str] = set()

    def is_new(self, result: TrackingResult) -> bool:
        """Whether this result says what the ones before did not."""
        if result.state is not self._state:
            self._state, self._said = result.state, set()
        elif not result.reason or without_figures(result.reason) in self._said:
            return False
        self._said.add(without_figures(result.reason))
        return True


class Progress(Protocol):
    """Told about each frame and stage; used as a context manager."""

    def __enter__(self) -> Progress: ...
    def __exit__(self, *exc: object) -> None: ...
    def frame(self, result: TrackingResult, scene: Scene, unreadable: int) -> None: ...
    def stage(self, text: str) -> None: ...


class Silent:
    """Shows nothing."""

    def __enter__(self) -> Silent:
        return self

    def __exit__(self, *exc: object) -> None:
        """Nothing."""

    def frame(self, result: TrackingResult, scene: Scene, unreadable: int) -> None:
        """Nothing."""

    def stage(self, text: str) -> None:
        """Nothing."""


class Bar:
    """A bar with state, rate and map size; log lines, changes of state and reasons for waiting scroll above it."""

    def __init__(self, console: Console, total: int | None) -> None:
        self._console = console
        self._bar = RichProgress(
            TextColumn("{task.fields[state]}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[facts]}"),
            TimeRemainingColumn(compact=True),
            console=console,
            transient=True,
        )
        self._task = self._bar.add_task("frames", total=total, state="starting", facts="")
        self._handler = RichHandler(console=console, level=logging.WARNING, show_path=False, show_time=False, markup=False)
        self._began = time.monotonic()
        self._news = News()
        self._frames = self._keyframes = self._landmarks = 0

    def __enter__(self) -> Bar:
        logging.getLogger("thegra_core").addHandler(self._handler)
        self._bar.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._bar.stop()
        logging.getLogger("thegra_core").removeHandler(self._handler)

    def frame(self, result: TrackingResult, scene: Scene, unreadable: int) -> None:
        """Advance by a frame, and say it when the state or the reason for waiting changes."""
        self._frames += 1
        if result.is_keyframe:
            self._keyframes, self._landmarks = scene.map_size()
        if self._news.is_new(result):
            reason = f": {escape(result.reason)}" if result.reason else ""
            self._console.print(f"  frame {self._frames}: {_coloured(result.state)}{reason}", highlight=False, soft_wrap=True)
        fps = self._frames / max(time.monotonic() - self._began, 1e-9)
        problems = f" · {unreadable} unreadable" if unreadable else ""
        facts = f"{fps:.1f} fps · {self._keyframes} keyframes · {self._landmarks} landmarks{problems}"
        self._bar.update(self._task, advance=1, state=_coloured(result.state), facts=facts)

    def stage(self, text: str) -> None:
        """Name what goes on after the last frame."""
        self._bar.update(self._task, state=text)


def make_progress(quiet: bool, total: int | None) -> Progress:
    """The bar on stderr, or nothing when quiet."""
    return Silent() if quiet else Bar(Console(stderr=True), total)


def headline(metrics: dict[str, Any]) -> str:
    """The run in one line."""
    told = metrics.get("ate_rmse") is not None and metrics["tracked_pct"] >= MIN_COVERAGE_PCT
    ate = f", ATE {metrics['ate_rmse']:.4g}" if told else ""
    return f"{metrics['frames_tracked']} of {metrics['frames_total']} frames tracked ({metrics['tracked_pct']:g} %){ate}"


def print_summary(written: WrittenRun, quiet: bool, interrupted: bool, reason: str) -> None:
    """The final table, or one line when quiet; `reason` is the last that the system gave for having no pose."""
    metrics = written.metrics
    head = f"{'interrupted: ' if interrupted else ''}{headline(metrics)}"
    if not metrics["frames_tracked"] and reason:
        head += f": {reason}"
    console = Console(highlight=False)
    if quiet:
        console.print(f"{head}; {written.folder}", soft_wrap=True, markup=False)
        return
    table = Table(title=escape(head), show_header=False, title_justify="left")
    for name, value in summary_rows(metrics):
        table.add_row(name, value)
    console.print(table)
    console.print(f"trajectory  {written.folder / 'trajectory.txt'}\nreport      {written.report}", soft_wrap=True, markup=False)


def summary_rows(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of what a user looks at first; the error always beside the coverage, which it means nothing without."""
    rows = [
        ("tracked", f"{metrics['tracked_pct']:g} % of {metrics['frames_total']} frames"),
        ("ATE (Sim3)", _error(metrics)),
        ("held / lost / initializing", f"{metrics['frames_held']} / {metrics['frames_lost']} / {metrics['frames_initializing']}"),
        ("maps, keyframes, landmarks", f"{metrics['maps']}, {metrics['keyframes']}, {metrics['landmarks']}"),
        ("losses, relocalizations", f"{metrics['losses']}, {metrics['relocalizations']}"),
        ("speed", _speed(metrics)),
        ("memory", f"{metrics['peak_rss_mb']} MB"),
    ]
    if metrics["frames_bad"]:
        rows.insert(3, ("bad frames", ", ".join(f"{count} {reason}" for reason, count in metrics["bad_frames"].items())))
    return rows


def _speed(metrics: dict[str, Any]) -> str:
    median, slow = metrics["ms_per_frame"]["p50"], metrics["ms_per_frame"]["p95"]
    rate = f"{metrics['fps']:.3g} fps" if metrics["fps"] else "-"
    return rate if median is None else f"{rate}, {median:.4g} ms a frame (95 %: {slow:.4g})"


def _error(metrics: dict[str, Any]) -> str:
    if "ate_rmse" not in metrics:
        return "no ground truth"
    if metrics["ate_rmse"] is None:
        return "fewer than 3 frames with pose and ground truth"
    if metrics["tracked_pct"] < MIN_COVERAGE_PCT:
        return f"- (fewer than {MIN_COVERAGE_PCT:g} % of the frames have a pose)"
    live = f"; as estimated at the time {metrics['ate_live_rmse']:.4g}" if metrics["ate_live_rmse"] is not None else ""
    return f"{metrics['ate_rmse']:.4g} over {metrics['ate_pairs']} frames of a path of {metrics['path_length']:.4g}{live}"


def without_figures(text: str) -> str:
    """The text with its numbers blanked, so that a reason counts as the same while only its figures change."""
    return re.sub(r"\d+(\.\d+)?", "#", text)


def _coloured(state: TrackingState) -> str:
    return f"[{_COLOURS[state]}]{state.value}[/]"
