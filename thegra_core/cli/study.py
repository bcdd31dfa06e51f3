"""`thegra study`: the paper's experiment on one's own recordings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

from thegra_core.errors import ConfigError
from thegra_core.evaluation.study import figures, summary
from thegra_core.evaluation.study.run import Plan, Row, run_study, variants
from thegra_core.evaluation.study.variants import CHAINS, FRONT_ENDS, PAPER_CHAIN
from thegra_core.features.registry import make_extractor
from thegra_core.outputs.files import write_atomic
from thegra_core.preprocessing.chain import Chain
from thegra_core.sources.open import open_recording

CONTRAST = ("stretch", "HE", "HE + median", "CLAHE", "CLAHE + median")
"""The paper's Fig. 3; the chains that are not here and the best of these are its Fig. 4."""


def plan_study(
    recordings: Sequence[Path], interval_s: float, pairs: int, chains: Sequence[str] | None, front_ends: Sequence[str] | None, cache: Path | None, out: Path
) -> Plan:
    """The plan from the command's options.

    Raises:
        ConfigError: If a chain or a front end is unknown.
    """
    for kind, asked, known in (("--chain", chains or (), CHAINS), ("--front-end", front_ends or (), FRONT_ENDS)):
        for name in asked:
            if name not in known:
                raise ConfigError(f"{kind} {name!r} is unknown; known: {', '.join(repr(k) for k in known)}")
    chosen = tuple(front_ends or FRONT_ENDS)
    return Plan(tuple(recordings), out, interval_s, pairs, chosen[0], tuple(chains or CHAINS), chosen, cache)


def study(plan: Plan) -> list[Path]:
    """Run the study with a progress bar, write its files, and print the table; returns the files."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Table

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=len(plan.recordings) * len(variants(plan)) + 1)

        def say(text: str) -> None:
            bar.update(task, description=text)
            bar.advance(task)

        rows = run_study(plan, say)
    files = [plan.out / "study.csv", *_write(plan, rows)]
    shown = Table()
    for name in summary.HEADER:
        shown.add_column(name, overflow="fold")
    for line in summary.table(rows):
        shown.add_row(*line)
    console = Console(highlight=False)
    console.print(shown)
    for file in files:
        console.print(str(file), soft_wrap=True, markup=False)
    return files


def _write(plan: Plan, rows: list[Row]) -> list[Path]:
    by_chain = [row for row in rows if row.front_end == plan.front_end]
    filters = [name for name in plan.chains if name not in CONTRAST or name == "HE + median"]
    pictures = {
        "contrast.png": ([c for c in CONTRAST if c in plan.chains], by_chain, "chain", f"contrast enhancement, {plan.front_end}"),
        "filters.png": (filters, by_chain, "chain", f"filters, {plan.front_end}"),
        "front_ends.png": (list(plan.front_ends), [row for row in rows if row.chain == PAPER_CHAIN], "front_end", f"front ends, {PAPER_CHAIN}"),
    }
    files = [write_atomic(plan.out / "study.md", summary.markdown(rows, plan.interval_s))]
    for file, (names, shown, by, title) in pictures.items():
        if names:
            files.append(write_atomic(plan.out / file, figures.box_plots(shown, names, by, title)))
    return [*files, _write_detections(plan)]


def _write_detections(plan: Plan) -> Path:
    """The middle frame of the first recording before and after."""
    recording = open_recording(plan.recordings[0])
    middle = sum(1 for _ in recording.frames()) // 2
    frame = next(itertools.islice(recording.frames(), middle, None))
    extractor = make_extractor(FRONT_ENDS[plan.front_end].extractor)
    images = [Chain(CHAINS[name])(frame.image, frame.stamp_ns) for name in ("stretch", PAPER_CHAIN)]
    features = [extractor.extract(image, frame.stamp_ns) for image in images]
    return write_atomic(plan.out / "detections.png", figures.detections(images[0], features[0], images[1], features[1]))
