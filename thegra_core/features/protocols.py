"""The plug points of the front end: extractor, matcher, and what makes features of a stream of images with them."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, unique
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import Features, Matches


class Extractor(Protocol):
    """Finds keypoints and describes them."""

    @property
    def name(self) -> str:
        """Registry name; `Features.extractor` of what it returns."""
        ...

    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """Features of a single-channel image (H, W) uint8, at most `max_keypoints`, strongest first; none at all is a valid answer."""
        ...


class Matcher(Protocol):
    """Pairs the features of two frames."""

    @property
    def name(self) -> str:
        """Registry name."""
        ...

    def match(self, query: Features, reference: Features) -> Matches:
        """One-to-one matches of two feature sets of the same extractor, sorted by query index; empty if either set is empty."""
        ...

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """`match` against each reference, where the matcher can share work between them."""
        ...


@unique
class Wanted(Enum):
    """What to do where followed keypoints do not suffice."""

    MORE = "more"  # detect, and go on with those followed
    ANEW = "anew"  # detect, and forget those followed


class FrontEnd(Protocol):
    """Makes features of a stream of images."""

    def follow(self, image: NDArray[np.uint8], stamp_ns: int, likely: bool = False) -> Features | None:
        """Take the next image (H, W) uint8; keypoints of earlier ones found again in it, None if these are too few, or nothing is ever followed.

        likely: `detect` will most likely be called for this image: it may begin beside this, and changes nothing of what either returns.
        """
        ...

    def detect(self, wanted: Wanted = Wanted.MORE) -> Features:
        """What can be detected in the image taken last, with or without what was followed to it."""
        ...

    def forget(self) -> None:
        """The stream was interrupted: follow nothing into the next image."""
        ...
