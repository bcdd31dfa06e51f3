"""Starting a map (paper Sec. III-C, Map initialization), and waiting as long as one would be a guess."""

from __future__ import annotations

import logging
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import NO_LANDMARK, Features, InitialMap, Keyframe, Matches
from thegra_core.optimization.weighting import observation_weights
from thegra_core.process import Submit, call_now
from thegra_core.tracking.first_map import FirstMap, TrackTable, distinct, solve_first_map
from thegra_core.tracking.hypotheses import MotionHypothesis, motion_hypotheses, parallax_to_noise

FloatArray = NDArray[np.float64]
logger = logging.getLogger(__name__)

SMALL_SAMPLE = 5.0
"""Margin over the square root of the number of matches on the parallax-to-noise limit: the standard error of a ratio of two medians is about 1.7 over
that root, and three of them cover the best of several hypotheses and frames."""

@dataclass(slots=True)
class _Candidate:
    features: Features
    normalized: FloatArray
    weights: FloatArray
    to_reference: Matches | None = field(default=None)


@dataclass(frozen=True, slots=True)
class _Attempt:
    """What is being solved: views, the matches of the last to the first, and the `FirstMap` to come, or why there is none."""

    views: list[_Candidate]
    matches: Matches
    solution: Future[FirstMap | str]


class Initializer:
    """Collects frames until a map can be claimed.

    `reference_features` is the frame that the next one should be matched to. Every refusal gives its reason in words. What takes long, the bundle
    adjustment under each hypothesis, is done by `submit`; while it has not come back, frames are only collected.
    """

    def __init__(self, camera: CameraModel, config: ThegraConfig, matcher: Matcher, submit: Submit = call_now) -> None:
        self._camera = camera
        self._config = config
        self._matcher = matcher
        self._rng = np.random.default_rng(config.seed)
        self._frames: list[_Candidate] = []  # the first is the reference
        self._starved = 0
        self._submit = submit
        self._attempt: _Attempt | None = None

    @property
    def reference_features(self) -> Features | None:
        return self._frames[0].features if self._frames else None

    def reset(self) -> None:
        """Forget all frames, for example after a shutter closure that changed the image."""
        self._frames = []
        self._starved = 0
        self._attempt = None

    def add(self, features: Features, matches: Matches | None, map_id: int, next_keyframe_id: int) -> InitialMap | str:
        """The next frame, with its matches to `reference_features` if there are any already; a first map, or why there is none yet.

        The map's last keyframe is this frame, or an earlier one where solving took its time.
        """
        settings = self._config.initialization
        normalized = self._camera.undistort(features.keypoints.astype(np.float64))
        self._frames.append(_Candidate(features, normalized, observation_weights(features.scores, self._config.weighting)))
        if len(self._frames) == 1:
            return "first frame" if len(features) >= settings.min_matches else f"only {len(features)} keypoints: too little contrast in the image"
        if matches is None or matches.reference_stamp_ns != self._frames[0].features.stamp_ns:
            matches = self._matcher.match(features, self._frames[0].features)
        matches = self._advance_reference(matches)
        self._frames[-1].to_reference = matches
        if self._attempt is not None:
            return self._outcome(self._attempt, map_id, next_keyframe_id)
        if len(matches) < settings.min_matches:
            return f"{len(matches)} matches to the reference frame, {settings.min_matches} needed: move more slowly, or towards more thermal contrast"
        attempt = self._begin_attempt(matches)
        return attempt if isinstance(attempt, str) else self._outcome(attempt, map_id, next_keyframe_id)

    def _outcome(self, attempt: _Attempt, map_id: int, next_keyframe_id: int) -> InitialMap | str:
        if not attempt.solution.done():
            self._attempt = attempt
            return "a first map is being solved"
        self._attempt, solved = None, attempt.solution.result()
        return solved if isinstance(solved, str) else self._as_map(solved, attempt.views, attempt.matches, map_id, next_keyframe_id)

    def _advance_reference(self, matches: Matches) -> Matches:
        """Paper: too few correspondences over too long a gap advance the reference frame, half the gap at a time.

        A single frame without matches (blur, a hand before the lens) moves nothing.
        """
        settings = self._config.initialization
        self._starved = self._starved + 1 if len(matches) < settings.min_matches else 0
        while len(self._frames) > 2 and (self._starved > settings.max_starved_frames or len(self._frames) > settings.max_gap_frames):
            self._frames = self._frames[max(1, (len(self._frames) - 1) // 2) :]
            for candidate in self._frames:
                candidate.to_reference = None
            matches = self._matcher.match(self._frames[-1].features, self._frames[0].features)
            if len(matches) >= settings.min_matches:
                self._starved = 0
        return matches

    def _begin_attempt(self, matches: Matches) -> _Attempt | str:
        settings = self._config.initialization
        reference, current = self._frames[0], self._frames[-1]
        x0, x1 = reference.normalized[matches.indices[:, 1]], current.normalized[matches.indices[:, 0]]
        defined = np.isfinite(x0).all(axis=1) & np.isfinite(x1).all(axis=1)
        x0, x1 = x0[defined], x1[defined]
        if len(x0) < settings.min_matches:
            return f"{len(x0)} matches inside the camera model's field, {settings.min_matches} needed: check the calibration"
        hypotheses = motion_hypotheses(x0, x1, self._camera.focal, settings, self._rng)
        flow, ratio = parallax_to_noise(x0, x1, self._camera.focal, hypotheses)
        needed = settings.min_parallax_to_noise * (1.0 + SMALL_SAMPLE / np.sqrt(len(x0)))
        if ratio < needed:
            return f"no parallax: a pure rotation explains the matches to {flow:.1f} px, {ratio:.1f} times their noise, {needed:.1f} needed: move sideways"
        views = [reference, *self._between(), current]
        views = [replace(view) for view in views]  # of its own: the reference may advance meanwhile
        return _Attempt(views, matches, self._submit(decide, self._tabulate(views, matches), hypotheses, self._config))

    def _between(self) -> list[_Candidate]:
        """Frames evenly spread between reference and current, matched to the reference when they are not yet."""
        middle = self._frames[1:-1]
        count = min(self._config.initialization.between_views, len(middle))
        chosen = [middle[i] for i in np.unique(np.linspace(0, len(middle) - 1, count + 2).round().astype(int)[1:-1])] if count else []
        for candidate in chosen:
            if candidate.to_reference is None:
                candidate.to_reference = self._matcher.match(candidate.features, self._frames[0].features)
        return [c for c in chosen if c.to_reference is not None and len(c.to_reference) >= self._config.initialization.min_matches]

    def _keypoints(self, views: list[_Candidate], matches: Matches) -> NDArray[np.int64]:
        """(V, M) keypoint index in each view of the reference keypoints that the current frame was matched to, -1 where there is none."""
        wanted = matches.indices[:, 1]
        table = np.full((len(views), len(wanted)), -1, dtype=np.int64)
        table[0], table[-1] = wanted, matches.indices[:, 0]
        for row, view in enumerate(views[1:-1], start=1):
            assert view.to_reference is not None
            partner = np.full(len(views[0].features), -1, dtype=np.int64)
            partner[view.to_reference.indices[:, 1]] = view.to_reference.indices[:, 0]
            table[row] = partner[wanted]
        return table

    def _tabulate(self, views: list[_Candidate], matches: Matches) -> TrackTable:
        keypoints = self._keypoints(views, matches)
        normalized = np.stack([np.where((k >= 0)[:, None], v.normalized[k], np.nan) for v, k in zip(views, keypoints, strict=True)])
        weights = np.stack([v.weights[k] for v, k in zip(views, keypoints, strict=True)])
        undefined = ~(np.isfinite(normalized[0]).all(axis=1) & np.isfinite(normalized[-1]).all(axis=1))
        normalized[:, undefined] = np.nan
        return TrackTable(normalized, weights, self._camera.focal)

    def _as_map(self, solved: FirstMap, views: list[_Candidate], matches: Matches, map_id: int, next_keyframe_id: int) -> InitialMap:
        """The solution in map units: median depth 1 in the reference view."""
        scale = 1.0 / float(np.median(solved.points_world[solved.good, 2]))
        keypoints = self._keypoints(views, matches)
        point_row = np.cumsum(solved.good) - 1
        keyframes = []
        for row, view in enumerate(views):
            pose = solved.world_from_camera[row].copy()
            pose[:3, 3] *= scale
            ids = np.full(len(view.features), NO_LANDMARK, dtype=np.int64)
            seen = solved.used[row] & (keypoints[row] >= 0)
            ids[keypoints[row][seen]] = point_row[seen]
            reference_id = next_keyframe_id if row else -1
            keyframes.append(Keyframe(next_keyframe_id + row, view.features.stamp_ns, pose, view.features, ids, reference_id, map_id, view.to_reference))
        return InitialMap(map_id, tuple(keyframes), scale * solved.points_world[solved.good])


def decide(table: TrackTable, hypotheses: list[MotionHypothesis], config: ThegraConfig) -> FirstMap | str:
    """The first map that explains the matches best, or why none may be claimed."""
    settings = config.initialization
    attempts = (solve_first_map(table, h.camera1_from_camera0, h.model, config) for h in hypotheses)
    solved = sorted((m for m in attempts if m is not None), key=lambda m: m.cost)
    if not solved:
        return "no motion explains the matches: moving objects, or wrong intrinsics"
    best = solved[0]
    logger.debug("start: %s", [(m.model, round(m.cost, 3), int(m.good.sum()), round(m.parallax_deg, 2)) for m in solved])
    if best.good.sum() < settings.min_points:
        return f"{int(best.good.sum())} points triangulated, {settings.min_points} needed: move sideways, or towards more thermal contrast"
    share = float(best.good.mean())
    if share < settings.min_inlier_ratio:
        return f"the best motion explains {100 * share:.0f} % of the matches, {100 * settings.min_inlier_ratio:.0f} % needed: moving objects, or wrong intrinsics"
    if best.parallax_deg < settings.min_parallax_deg:
        return f"parallax {best.parallax_deg:.2f} deg, {settings.min_parallax_deg:g} needed: move sideways"
    others = [m for m in solved[1:] if distinct(best, m)]
    if others and others[0].cost < settings.ambiguity_ratio * best.cost:
        return "the scene looks flat and two motions explain it alike: keep moving, further views decide"
    return best
