"""Images turned by quarter turns: learned descriptors know up from down, and a camera that looks at the ground comes back turned round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thegra_core.features.protocols import Extractor, Matcher
from thegra_core.messages import Features, Matches, TurnedView

SAME_KEYPOINT_PX = 2.0
"""A keypoint of the turned image is the upright one that it falls on to within this."""


def turned_view(image: NDArray[np.uint8], upright: Features, quarter_turns: int, extractor: Extractor) -> TurnedView:
    """What the extractor finds in an image (H, W) turned counter-clockwise by quarter turns, and which of the upright keypoints that is."""
    turned = extractor.extract(np.ascontiguousarray(np.rot90(image, quarter_turns)), upright.stamp_ns)
    if len(upright) == 0 or len(turned) == 0:
        return TurnedView(turned, np.full(len(turned), -1, dtype=np.int64))
    pixels = turn_back(turned.keypoints.astype(np.float64), quarter_turns, upright.image_size)
    there = cKDTree(upright.keypoints)
    distance, nearest = there.query(pixels, distance_upper_bound=SAME_KEYPOINT_PX)
    found = np.where(np.isfinite(distance), nearest, -1).astype(np.int64)
    order = np.argsort(distance, kind="stable")  # of several that fall on one keypoint the nearest
    first = order[np.sort(np.unique(found[order], return_index=True)[1])]
    upright_of = np.full(len(turned), -1, dtype=np.int64)
    upright_of[first] = found[first]
    return TurnedView(turned, upright_of)


def turn_back(pixels: NDArray[np.float64], quarter_turns: int, image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Pixels (N, 2) of the turned image in the upright one of `image_size` (width, height)."""
    width, height = image_size
    x, y = pixels[:, 0], pixels[:, 1]
    back = {0: (x, y), 1: (width - 1 - y, x), 2: (width - 1 - x, height - 1 - y), 3: (y, height - 1 - x)}[quarter_turns % 4]
    return np.stack(back, axis=1)


@dataclass(frozen=True, slots=True)
class TurnedMatcher:
    """`Matcher` of one image that looks at it turned: whatever it is asked about, it matches that view, and answers in upright keypoints."""

    inner: Matcher
    view: TurnedView

    @property
    def name(self) -> str:
        return self.inner.name

    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`."""
        return self._upright(self.inner.match(self.view.features, reference))

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        return [self._upright(matches) for matches in self.inner.match_many(self.view.features, references)]

    def _upright(self, matches: Matches) -> Matches:
        query = self.view.upright[matches.indices[:, 0]]
        rows = np.flatnonzero(query >= 0)
        rows = rows[np.argsort(query[rows], kind="stable")]
        indices = np.stack((query[rows], matches.indices[rows, 1]), axis=1).astype(np.int32)
        return Matches(matches.stamp_ns, matches.reference_stamp_ns, indices, matches.confidence[rows])
