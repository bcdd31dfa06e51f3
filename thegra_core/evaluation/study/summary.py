"""The study as a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thegra_core.evaluation.study.run import Row

HEADER = ("recording", "chain", "front end", "keypoints", "matches", "inliers", "right", "epipolar px", "spread %")


def table(rows: Sequence[Row]) -> list[list[str]]:
    """One row for each recording, chain and front end: medians over the pairs; "–" where there is no ground truth."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.recording, row.chain, row.front_end), []).append(row)
    lines = []
    for (recording, chain, front_end), group in groups.items():
        results = [row.result for row in group]
        lines.append([
            recording, chain, front_end, *(_median([getattr(r, name) for r in results], "{:.0f}") for name in ("keypoints", "matches", "inliers", "right")),
            _median([r.epipolar_px for r in results], "{:.2f}"), _median([100 * r.spread for r in results], "{:.0f}"),
        ])  # fmt: skip
    return lines


def markdown(rows: Sequence[Row], interval_s: float) -> str:
    """A GitHub table and a line that explains it."""
    lines = [list(HEADER), ["---"] * len(HEADER), *table(rows)]
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    return (
        f"{text}\nMedians over pairs of frames {interval_s:g} s apart (the next frame where frames are further apart). Inliers: MAGSAC, essential matrix, "
        "1 px. Right: matches within 3 px of the true epipolar line; epipolar px: median distance of all matches to it. Spread: 8x8 cells of the image with an inlier.\n"
    )


def _median(values: Sequence[float | int | None], form: str) -> str:
    known = [v for v in values if v is not None]
    return form.format(float(np.median(known))) if known else "–"
