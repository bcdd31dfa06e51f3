"""From a stream of images to features: every image on its own, or detect on some and follow in between."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thegra_core.config import FlowConfig
from thegra_core.features.anchors import Anchors, anchor, joined, lay, outgrown, renewed, worn
from thegra_core.features.detection import spread
from thegra_core.features.flow import Followed, Points, confirmed, normalize_contrast, step
from thegra_core.features.protocols import Extractor, Wanted
from thegra_core.features.registration import coarse_shift, follow_far
from thegra_core.features.tracks import only_followed
from thegra_core.messages import UNFOLLOWED, Features

Image = NDArray[np.uint8]
CROWDING = 1.0
"""Of the points that are followed: each part of the image has its even share of them, see `spread`."""
MOST_WORN = 0.5
"""Share of the points that may look like something else before the image is taken to."""
NEW = -2
"""Number of a keypoint that may be followed from now on."""


class DetectEach:
    """`FrontEnd` that detects in every image."""

    def __init__(self, extractor: Extractor) -> None:
        self._extractor = extractor
        self._last: tuple[Image, int] | None = None

    def follow(self, image: Image, stamp_ns: int, likely: bool = False) -> Features | None:
        """See `FrontEnd.follow`; always None."""
        self._last = image, stamp_ns
        return None

    def detect(self, wanted: Wanted = Wanted.MORE) -> Features:
        """See `FrontEnd.detect`."""
        assert self._last is not None
        return self._extractor.extract(*self._last)

    def forget(self) -> None:
        """See `FrontEnd.forget`."""


@dataclass(frozen=True, slots=True)
class _Trail:
    """The last image as it was seen and normalized, and the points that are followed in it, with what they looked like; `detected` counts those after the last
    detection."""

    image: Image
    normalized: Image
    features: Features
    anchors: Anchors
    detected: int


class DetectAndFollow:
    """`FrontEnd` that detects when it must or is told to, and follows these keypoints through the images between.

    A keypoint keeps number, descriptor and the score of its detection, which falls with how its surroundings change. Detecting again keeps what is
    followed where it is, with a descriptor of what is detected there, and adds what is detected elsewhere; what does not look any more like what it was is
    followed no longer. Beyond `max_points` keypoints are not followed: they are there to be matched.
    """

    def __init__(self, extractor: Extractor, config: FlowConfig) -> None:
        self._extractor = extractor
        self._config = config
        self._trail: _Trail | None = None
        self._next_id = 0
        self._beside = ThreadPoolExecutor(1, "thegra detecting")
        self._early: Future[Features] | None = None

    def follow(self, image: Image, stamp_ns: int, likely: bool = False) -> Features | None:
        """See `FrontEnd.follow`."""
        self._early = self._detecting(image, stamp_ns) if likely else None
        normalized, before = normalize_contrast(image), self._trail
        if before is None or before.normalized.shape != image.shape:
            nothing = _none(stamp_ns, image)
            self._trail = _Trail(image, normalized, nothing, self._anchored(normalized, nothing), 0)
            return None
        followed, anchors = self._followed(before, image, normalized, stamp_ns)
        self._trail = _Trail(image, normalized, followed, anchors, before.detected)
        return followed if len(followed) >= max(self._config.min_points, self._config.min_share * before.detected) else None

    def detect(self, wanted: Wanted = Wanted.MORE) -> Features:
        """See `FrontEnd.detect`."""
        assert self._trail is not None
        trail = self._without_worn(self._trail)
        found = (self._early or self._detecting(trail.image, trail.features.stamp_ns)).result()
        candidates = spread(found.keypoints, found.scores, self._config.max_points, found.image_size, CROWDING)
        ids = np.full(len(found), UNFOLLOWED, np.int64)
        ids[candidates] = NEW
        features = replace(found, track_ids=ids)
        if wanted is Wanted.MORE:
            features = merged(trail.features, features, self._config.near_px)
        features = self._numbered(features)
        followed = only_followed(features)
        kept = replace(trail.anchors, scores=followed.scores[: len(trail.anchors)]) if wanted is Wanted.MORE else trail.anchors.chosen(np.empty(0, np.int64))
        new = self._anchored(trail.normalized, followed.chosen(np.arange(len(kept), len(followed))))
        self._trail = _Trail(trail.image, trail.normalized, followed, joined(kept, new), len(followed))
        return features

    def forget(self) -> None:
        """See `FrontEnd.forget`."""
        self._trail = None

    def _detecting(self, image: Image, stamp_ns: int) -> Future[Features]:
        """Detection, by a thread of its own: one at a time."""
        return self._beside.submit(self._extractor.extract, image, stamp_ns)

    def _followed(self, before: _Trail, image: Image, normalized: Image, stamp_ns: int) -> tuple[Features, Anchors]:
        """The points found: each where its square lies, if that can be said, else where the step from the last image has led.

        Where they have to be sought with more effort the image will most likely have to be detected in, too, which begins meanwhile.
        """
        points, images = before.features.keypoints, (before.normalized, normalized)
        there, inside = step(*images, points, points + coarse_shift(*images), self._config)
        result, exact, anchors = self._checked(before, normalized, there, inside)
        if len(points) and result.found.mean() < self._config.far_share:
            self._early = self._early or self._detecting(image, stamp_ns)
            far = follow_far(*images, points, result, self._config)
            result, exact, anchors = self._checked(before, normalized, far.points, far.found, far)
        chosen = np.flatnonzero(result.found)
        old = before.features
        assert old.track_ids is not None
        scores = np.where(exact, anchors.scores, old.scores)[chosen] * result.similarity[chosen]
        features = Features(stamp_ns, result.points[chosen], scores, old.descriptors[chosen], old.image_size, old.extractor, old.track_ids[chosen], old.turns)
        return features, anchors.chosen(chosen)

    def _checked(
        self, before: _Trail, normalized: Image, there: Points, inside: NDArray[np.bool_], known: Followed | None = None
    ) -> tuple[Followed, NDArray[np.bool_], Anchors]:
        """Points whose square is found where the step has led are right; the others have to be confirmed, if they are not `known` to be."""
        places, exact, anchors = lay(before.anchors, normalized, there, self._config)
        exact &= inside
        other = known if known is not None else confirmed(before.normalized, normalized, before.features.keypoints, there, inside & ~exact, self._config)
        similarity = np.where(exact, anchors.similarity, other.similarity)
        return Followed(np.where(exact[:, None], places, there), exact | other.found, similarity), exact, anchors

    def _anchored(self, normalized: Image, features: Features) -> Anchors:
        return anchor(normalized, features.keypoints, features.scores, self._config.patch)

    def _without_worn(self, trail: _Trail) -> _Trail:
        """Follow no longer what does not look any more like what was detected, and take what is just nearer or farther as it looks there.

        Where most does not look alike the image looks different, not the points: all are taken as they look there.
        """
        gone = worn(trail.anchors, self._config)
        if gone.sum() > MOST_WORN * len(gone):
            again = np.arange(len(gone))
        else:
            rows = np.flatnonzero(~gone)
            trail = replace(trail, features=trail.features.chosen(rows), anchors=trail.anchors.chosen(rows))
            again = np.flatnonzero(outgrown(trail.anchors))
        return replace(trail, anchors=renewed(trail.anchors, again, self._anchored(trail.normalized, trail.features.chosen(again))))

    def _numbered(self, features: Features) -> Features:
        """Give a number to each new keypoint, as long as there are not `max_points` with one."""
        assert features.track_ids is not None
        ids = features.track_ids.copy()
        new = np.flatnonzero(ids == NEW)
        ids[new] = UNFOLLOWED
        new = new[: max(self._config.max_points - int((ids >= 0).sum()), 0)]
        ids[new] = np.arange(self._next_id, self._next_id + len(new))
        self._next_id += len(new)
        return replace(features, track_ids=ids)


def merged(followed: Features, detected: Features, near_px: float) -> Features:
    """Followed keypoints, and those detected farther than `near_px` from all of them with the numbers that they have.

    A followed keypoint takes descriptor and score of the nearest detected one that is near. Its place stays: it is what its track was measured at.
    """
    if len(followed) == 0 or len(detected) == 0:
        return followed if len(detected) == 0 else detected
    distance, nearest = cKDTree(detected.keypoints).query(followed.keypoints)
    near = distance <= near_px
    descriptors: NDArray[Any] = followed.descriptors.copy()
    scores = followed.scores.copy()
    descriptors[near], scores[near] = detected.descriptors[nearest[near]], detected.scores[nearest[near]]
    away = np.flatnonzero(cKDTree(followed.keypoints).query(detected.keypoints)[0] > near_px)
    assert followed.track_ids is not None and detected.track_ids is not None
    return Features(
        detected.stamp_ns,
        np.concatenate((followed.keypoints, detected.keypoints[away])),
        np.concatenate((scores, detected.scores[away])),
        np.concatenate((descriptors, np.asarray(detected.descriptors[away], descriptors.dtype))),
        detected.image_size,
        detected.extractor,
        np.concatenate((followed.track_ids, detected.track_ids[away])),
        detected.turns,
    )


def _none(stamp_ns: int, image: Image) -> Features:
    size = (image.shape[1], image.shape[0])
    return Features(stamp_ns, np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 0), np.float32), size, "", np.empty(0, np.int64))
