"""The two plug points of the front end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import Features, Matches


class Extractor(Protocol):
    """Finds keypoints and describes them."""

    name: str
    """Registry name; `Features.extractor` of what it returns."""

    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """Features of a single-channel image (H, W) uint8, at most `max_keypoints`, strongest first; none at all is a valid answer."""
        ...


class Matcher(Protocol):
    """Pairs the features of two frames."""

    name: str

    def match(self, query: Features, reference: Features) -> Matches:
        """One-to-one matches of two feature sets of the same extractor, sorted by query index; empty if either set is empty."""
        ...

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """`match` against each reference, where the matcher can share work between them."""
        ...
