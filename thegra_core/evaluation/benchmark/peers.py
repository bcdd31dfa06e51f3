"""Published or measured results of other systems, to set beside ours."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thegra_core.errors import InputError

PEER_COVERAGE_PCT = 50.0
"""Median coverage that a peer needs to be compared with."""


def read_peers(file: Path) -> dict[str, Any]:
    """{sequence: {peer: {variant: {"tracked_pct": [...], "ate_rmse": [...]}}}} of a JSON file.

    Raises:
        InputError: If it cannot be read or is of another form.
    """
    try:
        peers = json.loads(file.read_text(encoding="utf-8"))
        for systems in peers.values():
            best_peer(systems)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f'cannot use {file}: {error}; expected JSON {{sequence: {{peer: {{variant: {{"tracked_pct": [...], "ate_rmse": [...]}}}}}}}}') from error
    return dict(peers)


def best_peer(systems: Mapping[str, Any]) -> dict[str, Any] | None:
    """Among variants with a median coverage of at least `PEER_COVERAGE_PCT` and an ATE, the one with the lowest median ATE; None if there is none."""
    found = [
        {"peer": peer, "variant": variant, "tracked_pct": median_or_none(v["tracked_pct"], worst=0.0), "ate_rmse": median_or_none(v["ate_rmse"])}
        for peer, variants in systems.items()
        for variant, v in variants.items()
    ]
    able = [f for f in found if f["ate_rmse"] is not None and (f["tracked_pct"] or 0) >= PEER_COVERAGE_PCT]
    return min(able, key=lambda f: f["ate_rmse"], default=None)


def median_or_none(values: Sequence[float | None], worst: float = np.inf) -> float | None:
    """Median in which None counts as `worst`; None where that is infinite or there are no values."""
    if not values:
        return None
    median = float(np.median([worst if value is None else value for value in values]))
    return median if np.isfinite(median) else None
