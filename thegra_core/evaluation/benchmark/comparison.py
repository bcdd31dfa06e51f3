"""Errors of several ways to run beside those of one of them, on the same recordings: single ones vary by half with anything, so the mean of their ratios is told, and
how sure it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

CERTAINTY = 0.95


@dataclass(frozen=True, slots=True)
class Scored:
    """What came of one recording run in the way `label`; error: None where so little is tracked that it has none."""

    recording: str
    label: str
    tracked_pct: float
    error: float | None


@dataclass(frozen=True, slots=True)
class Comparison:
    """The errors of `label` over those of `against`.

    recordings: Those that both were run on; without_error: of these, those where either has none.
    ratio: Geometric mean over the others; between: in which its true value lies with a certainty of `CERTAINTY`, if the logarithms of the ratios are normally
        distributed (Student's t). None of too few recordings.
    tracked_pct: Mean over all of `recordings`, of `label` and of `against`.
    """

    label: str
    against: str
    recordings: int
    without_error: int
    ratio: float | None
    between: tuple[float, float] | None
    tracked_pct: tuple[float, float]

    def __str__(self) -> str:
        count = self.recordings - self.without_error
        ratio = "no ratio" if self.ratio is None else f"{self.ratio:.2f}"
        between = "" if self.between is None else f" ({100 * CERTAINTY:.0f} %: {self.between[0]:.2f} to {self.between[1]:.2f})"
        without = f", without {self.without_error} where one has no error" if self.without_error else ""
        tracked = " and ".join(f"{pct:.1f}" for pct in self.tracked_pct)
        return f"ATE of {self.label} over that of {self.against}: {ratio}{between}, geometric mean of {count} recordings{without}; tracked {tracked} %."


def sentences(comparisons: Sequence[Mapping[str, Any]]) -> list[str]:
    """Comparisons, as `dataclasses.asdict` makes them for a file, told."""
    return [str(Comparison(**comparison)) for comparison in comparisons]


def compare(results: Sequence[Scored], against: str) -> list[Comparison]:
    """Each other label beside `against`, in order of appearance; those without a recording in common are left out."""
    by_label: dict[str, dict[str, Scored]] = {}
    for result in results:
        by_label.setdefault(result.label, {})[result.recording] = result
    others = by_label.pop(against, {})
    compared = []
    for label, found in by_label.items():
        pairs = [(result, others[name]) for name, result in found.items() if name in others]
        if pairs:
            compared.append(_compared(label, against, pairs))
    return compared


def _compared(label: str, against: str, pairs: Sequence[tuple[Scored, Scored]]) -> Comparison:
    errors = [(one.error, other.error) for one, other in pairs if one.error and other.error]
    logs = np.array([np.log(one / other) for one, other in errors])
    tracked = (float(np.mean([one.tracked_pct for one, _ in pairs])), float(np.mean([other.tracked_pct for _, other in pairs])))
    ratio = float(np.exp(logs.mean())) if len(logs) else None
    return Comparison(label, against, len(pairs), len(pairs) - len(errors), ratio, _between(logs), tracked)


def _between(logs: np.ndarray) -> tuple[float, float] | None:
    if len(logs) < 2:
        return None
    half = stats.t.ppf((1 + CERTAINTY) / 2, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    return float(np.exp(logs.mean() - half)), float(np.exp(logs.mean() + half))
