"""The study over recordings: every pair of frames through every chain (with one front end) and every front end (with the paper's chain)."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from thegra_core.errors import InputError
from thegra_core.evaluation.study.measure import PairResult, measure_pair, true_motion
from thegra_core.evaluation.study.pairs import pairs_at_interval
from thegra_core.evaluation.study.variants import CHAINS, FRONT_ENDS, PAPER_CHAIN
from thegra_core.features.cache import cached_extractor, cached_matcher
from thegra_core.features.protocols import Extractor, Matcher
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.messages import Frame
from thegra_core.outputs.files import write_atomic, writing_to
from thegra_core.outputs.trajectory import Trajectory, read_tum
from thegra_core.preprocessing.chain import Chain
from thegra_core.sources.open import camera_for, open_recording
from thegra_core.sources.recording import Recording


@dataclass(frozen=True, slots=True)
class Plan:
    """What to study: pairs `interval_s` apart, at most `pairs` of each recording; chains with `front_end`, front ends with the paper's chain."""

    recordings: tuple[Path, ...]
    out: Path
    interval_s: float
    pairs: int = 20
    front_end: str = "SuperPoint + LightGlue"
    chains: tuple[str, ...] = tuple(CHAINS)
    front_ends: tuple[str, ...] = tuple(FRONT_ENDS)
    cache: Path | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """One line of study.csv: which pair of which recording, through what, and what came of it."""

    recording: str
    chain: str
    front_end: str
    first: int
    second: int
    seconds: float
    result: PairResult


def variants(plan: Plan) -> list[tuple[str, str]]:
    """(chain, front end) of every combination that is run, each once."""
    wanted = [*((chain, plan.front_end) for chain in plan.chains), *((PAPER_CHAIN, front_end) for front_end in plan.front_ends)]
    return list(dict.fromkeys(wanted))


def run_study(plan: Plan, progress: Callable[[str], None] | None = None) -> list[Row]:
    """Run it all and write study.csv.

    Raises:
        InputError: If a recording has no two frames that far apart, or the plan's folder cannot be written.
        WeightsError: If a network's weights are not there.
    """
    with writing_to(plan.out):
        pass  # told before the work
    rows: list[Row] = []
    say = progress or (lambda _: None)
    front_ends = {name: _front_end(name, plan.cache) for name in dict.fromkeys(front_end for _, front_end in variants(plan))}
    for path in plan.recordings:
        recording = open_recording(path)
        stamps = [frame.stamp_ns for frame in recording.frames()]
        pairs = pairs_at_interval(stamps, plan.interval_s, plan.pairs)
        if not pairs:
            raise InputError(f"{path}: no two frames lie {plan.interval_s:g} s apart; its length is told by: thegra info {path}")
        frames = _frames(recording, {i for pair in pairs for i in pair})
        for chain, front_end in variants(plan):
            say(f"{recording.name}: {chain}, {front_end}")
            rows += _study_pairs(recording, frames, pairs, chain, front_end, *front_ends[front_end])
    with writing_to(plan.out):
        write_atomic(plan.out / "study.csv", to_csv(rows))
    return rows


def to_csv(rows: Iterable[Row]) -> str:
    """Rows as CSV with a header; unknown figures are empty."""
    text = io.StringIO()
    names = [f.name for f in fields(PairResult)]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["recording", "chain", "front_end", "first", "second", "seconds", *names])
    for row in rows:
        figures = asdict(row.result)
        numbers = [f"{value:.4g}" if isinstance(value, float) else value for value in (figures[name] for name in names)]
        writer.writerow([row.recording, row.chain, row.front_end, row.first, row.second, f"{row.seconds:.3f}", *numbers])
    return text.getvalue()


def _study_pairs(
    recording: Recording,
    frames: dict[int, Frame],
    pairs: Sequence[tuple[int, int]],
    chain_name: str,
    front_end: str,
    extractor: Extractor,
    matcher: Matcher,
) -> list[Row]:
    camera, truth, chain = camera_for(recording), _truth(recording), Chain(CHAINS[chain_name])
    rows = []
    for first, second in pairs:
        a, b = frames[first], frames[second]
        motion = None if truth is None else _motion(truth, a.stamp_ns, b.stamp_ns)
        result = measure_pair(chain, extractor, matcher, a, b, camera, motion)
        rows.append(Row(recording.name, chain_name, front_end, first, second, (b.stamp_ns - a.stamp_ns) / 1e9, result))
    return rows


def _front_end(name: str, cache: Path | None) -> tuple[Extractor, Matcher]:
    chosen = FRONT_ENDS[name]
    if cache is None:
        return make_extractor(chosen.extractor), make_matcher(chosen.matcher, chosen.extractor)
    return cached_extractor(chosen.extractor, cache), cached_matcher(chosen.matcher, chosen.extractor, cache)


def _frames(recording: Recording, wanted: set[int]) -> dict[int, Frame]:
    """The wanted ones, by their place among the readable frames."""
    return {i: frame for i, frame in enumerate(recording.frames()) if i in wanted}


def _truth(recording: Recording) -> Trajectory | None:
    return read_tum(recording.groundtruth) if recording.groundtruth is not None else None


def _motion(truth: Trajectory, first_ns: int, second_ns: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None:
    """second_from_first by the poses nearest in time, None where there is none within half a period of the ground truth."""
    half = 0.5 * float(np.median(np.diff(truth.stamps_ns))) if len(truth) > 1 else 0.0
    found = []
    for stamp in (first_ns, second_ns):
        index = int(np.argmin(np.abs(truth.stamps_ns - stamp)))
        if abs(int(truth.stamps_ns[index]) - stamp) > half:
            return None
        found.append(truth.poses[index])
    return true_motion(*found)
