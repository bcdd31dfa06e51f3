"""The figures of the paper's Tables I and II (arXiv 2602.08531), as printed: ATE in metres and frames tracked in per cent.

Its columns are not all comparable: ORB-SLAM3, DSO and Thegra are aligned with a scale (Sim(3)), ROTIO with its own metric scale.
"""

from __future__ import annotations

from typing import NamedTuple

SYSTEMS = ("ORB-SLAM3", "ROTIO", "DSO", "Thegra (paper)")
NOT_TOLD = "--"


class Cell(NamedTuple):
    """One system on one sequence."""

    ate: str
    tracked: str


def _row(*cells: str) -> tuple[Cell, ...]:
    return tuple(Cell(*cell.split()) for cell in cells)


ROVTIO = {
    "alt1": _row("-- 93.06", "22.33 100", "-- 92.38", "0.14 100"),
    "alt2": _row("0.85 100", "0.31 100", "0.84 100", "0.30 100"),
    "sync": _row("-- 92.95", "0.13 100", "0.44 100", "0.15 100"),
    "lt1": _row("-- 98.53", "0.21 100", "0.18 100", "-- 98.75"),
    "lt2": _row("-- 85.12", "3.44 100", "0.51 100", "0.14 100"),
    "lt3": _row("-- 87.18", "13.40 100", "0.52 100", "0.13 100"),
}
"""Table I."""

VIVID = {
    "dark_aggresive": _row("-- 26.70", "72.43 100", "0.65 100", "<0.01 100"),
    "dark_robust": _row("-- 28.5", "0.14 100", "0.35 100", "0.48 100"),
    "dark_unstable": _row("-- 23.9", "28.42 100", "0.75 100", "0.73 100"),
    "global_aggresive": _row("-- 0", "7.15 100", "0.68 100", "0.01 100"),
    "global_robust": _row("-- 0", "0.20 100", "0.66 100", "0.27 100"),
    "global_unstable": _row("-- 0", "1.10 100", "0.63 100", "-- --"),
    "local_aggressive": _row("-- 17.5", "64.45 100", "0.26 27.8", "0.01 100"),
    "local_robust": _row("0.35 100", "0.13 100", "0.31 100", "0.35 100"),
    "local_unstable": _row("-- 37.1", "53.98 100", "0.40 100", "0.62 100"),
    "varying_robust": _row("-- 35.7", "0.14 100", "0.35 100", "0.26 100"),
    "outdoor_robust_day1": _row("1.43 100", "2.92 100", "2.55 100", "2.15 100"),
    "outdoor_robust_day2": _row("2.18 100", "2664.00 100", "5.48 100", "8.54 100"),
    "outdoor_robust_night1": _row("0.67 100", "738.83 100", "4.80 100", "3.19 100"),
    "outdoor_robust_night2": _row("0.50 100", "605.62 100", "3.17 100", "6.53 100"),
}
"""Table II."""

TABLES = {"rovtio": ROVTIO, "vivid": VIVID}

WEIGHTING = {"uniform": ("93.1/17", "100/75.7"), "paper": ("100/0", "100/0")}
"""Table III: median/IQR of the trajectory tracked before loss, per cent, on ROVTIO and on ViViD++."""
