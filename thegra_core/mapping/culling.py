"""Which landmarks leave the map (paper Sec. III-C, Map Points Culling; ORB-SLAM3's trial period)."""

from __future__ import annotations

from thegra_core.config import MappingConfig
from thegra_core.map.editor import MapEditor
from thegra_core.messages import VisibilityCounts


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
