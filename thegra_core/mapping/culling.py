"""Which landmarks and keyframes leave the map (paper Sec. III-C, Map Points Culling; ORB-SLAM3's trial period and redundant keyframes)."""

from __future__ import annotations

import numpy as np

from thegra_core.config import MappingConfig
from thegra_core.map.editor import MapEditor
from thegra_core.messages import NO_LANDMARK, VisibilityCounts

NEWEST_KEPT = 5
"""Newest keyframes of a map that never leave: tracking refers to them, a loop waits for the next, and their landmarks are still on trial."""
EXAMINED = 20
"""Neighbours of a new keyframe that are looked at, and as many of the rest of a map that is too large: bounded, whatever the map's size."""
ABOUT_AS_NEAR = 1.2
"""Distance of another observer over the keyframe's own up to which it sees a landmark as well; ORB-SLAM3: one octave of 1.2."""


def count_visibility(editor: MapEditor, seen: VisibilityCounts) -> list[int]:
    """Add what tracking counted; returns the landmarks concerned that still live."""
    alive = []
    for landmark, visible, found in zip(seen.landmark_ids.tolist(), seen.visible.tolist(), seen.found.tolist(), strict=True):
        if landmark in editor.observers:
            editor.visible[landmark] += visible
            editor.found[landmark] += found
            alive.append(landmark)
    return alive


def untrackable(editor: MapEditor, landmarks: list[int], config: MappingConfig) -> list[int]:
    """Landmarks found in less than `min_found_ratio` of the frames that should have seen them."""
    return [i for i in landmarks if editor.found[i] < config.min_found_ratio * editor.visible[i]]


def failed_trial(editor: MapEditor, landmarks: list[int], keyframe_id: int, config: MappingConfig) -> tuple[list[int], list[int]]:
    """Young landmarks, sorted into (to remove, still on trial).

    Once `trial_keyframes` keyframes came after its creation a landmark must have `trial_observations`; then it has passed for good.
    """
    remove, trial = [], []
    for landmark in landmarks:
        if landmark not in editor.observers:
            continue
        if keyframe_id - editor.first_keyframe[landmark] < config.trial_keyframes:
            trial.append(landmark)
        elif len(editor.observers[landmark]) < config.trial_observations:
            remove.append(landmark)
    return remove, trial


def remove_redundant(editor: MapEditor, keyframe_id: int, config: MappingConfig) -> list[int]:
    """Remove keyframes around a new one that others make redundant, and from a map beyond its budget the most redundant ones; returns their ids."""
    current = editor.map
    if len(current.keyframes) <= min(config.redundant_from, config.max_keyframes):
        return []
    ordered = sorted(current.keyframes)
    kept = {ordered[0], *ordered[-NEWEST_KEPT:]}
    removed = []
    for candidate in sorted(set(current.neighbours(keyframe_id, EXAMINED)) - kept):
        if len(current.keyframes) > config.redundant_from and redundancy(editor, candidate, config.redundant_observers) >= config.redundant_share:
            editor.remove_keyframe(candidate)
            removed.append(candidate)
    while len(current.keyframes) > max(config.max_keyframes, len(kept)):
        candidates = np.array([i for i in ordered if i in current.keyframes and i not in kept])
        some = np.random.default_rng(keyframe_id).choice(candidates, min(EXAMINED, len(candidates)), replace=False).tolist()
        near = [i for i in current.neighbours(keyframe_id, EXAMINED) if i not in kept]
        worst = max((*some, *near), key=lambda i: (redundancy(editor, i, config.redundant_observers), -i))
        editor.remove_keyframe(worst)
        removed.append(worst)
    return removed


def redundancy(editor: MapEditor, keyframe_id: int, observers: int) -> float:
    """Share of a keyframe's landmarks that at least so many other keyframes see from about as near or nearer; 1 for one that sees none."""
    keyframe = editor.map.keyframes[keyframe_id]
    ids = keyframe.landmark_ids[keyframe.landmark_ids != NO_LANDMARK]
    if len(ids) == 0:
        return 1.0
    index, observer, _ = editor.observations(ids)
    seeing, row = np.unique(observer, return_inverse=True)
    centers = np.stack([editor.map.keyframes[i].center for i in seeing.tolist()])
    points = editor.map.landmarks.points_world[editor.map.landmarks.rows(ids)]
    distance = np.linalg.norm(points[index] - centers[row], axis=1)
    own = np.linalg.norm(points - keyframe.center, axis=1)
    as_good = (observer != keyframe_id) & (distance <= ABOUT_AS_NEAR * own[index])
    return float(np.mean(np.bincount(index[as_good], minlength=len(ids)) >= observers))
