"""The 25 % rule and the trial period by hand."""

from __future__ import annotations

import numpy as np
import pytest
from test_map_editor import CAMERA, keyframe

from thegra_core.config import MappingConfig
from thegra_core.geometry import poses
from thegra_core.map.editor import MapEditor
from thegra_core.mapping.culling import NEWEST_KEPT, count_visibility, failed_trial, redundancy, remove_redundant, untrackable
from thegra_core.messages import VisibilityCounts


@pytest.fixture
def editor() -> MapEditor:
    """Three keyframes; landmarks 0-3, each seen by keyframes 0 and 1, landmark 3 by all."""
    editor = MapEditor(0, CAMERA, 3)
    for number in range(3):
        editor.add_keyframe(keyframe(number))
    for landmark in editor.add_landmarks(np.zeros((4, 3)), 1).tolist():
        editor.observe(landmark, 0, landmark)
        editor.observe(landmark, 1, landmark)
    editor.observe(3, 2, 3)
    return editor


def seen(counts: dict[int, tuple[int, int]]) -> VisibilityCounts:
    table = np.array([[i, visible, found] for i, (visible, found) in counts.items()], dtype=np.int64).reshape(-1, 3)
    return VisibilityCounts(table[:, 0], table[:, 1], table[:, 2])


def test_a_quarter_is_enough(editor: MapEditor) -> None:
    # a new landmark counts as once predicted and once found
    concerned = count_visibility(editor, seen({0: (7, 1), 1: (8, 1), 2: (0, 0), 3: (3, 3)}))
    assert [editor.visible[i] for i in range(4)] == [8, 9, 1, 4]
    assert [editor.found[i] for i in range(4)] == [2, 2, 1, 4]
    assert untrackable(editor, concerned, MappingConfig()) == [1]  # 2 of 9; 2 of 8 is exactly 25 %
    assert untrackable(editor, concerned, MappingConfig(min_found_ratio=0.0)) == []
    assert untrackable(editor, concerned, MappingConfig(min_found_ratio=0.26)) == [0, 1]


def test_counts_add_up_over_keyframes(editor: MapEditor) -> None:
    for _ in range(3):
        count_visibility(editor, seen({0: (5, 1)}))
    assert (editor.visible[0], editor.found[0]) == (16, 4)
    assert untrackable(editor, [0], MappingConfig()) == []
    count_visibility(editor, seen({0: (1, 0)}))
    assert untrackable(editor, [0], MappingConfig()) == [0]


def test_the_dead_are_not_counted(editor: MapEditor) -> None:
    editor.remove_landmarks([1])
    assert count_visibility(editor, seen({0: (1, 1), 1: (9, 0), 77: (9, 0)})) == [0]
    assert 1 not in editor.visible and 77 not in editor.visible


def test_trial(editor: MapEditor) -> None:
    config = MappingConfig(trial_keyframes=3, trial_observations=3)
    assert failed_trial(editor, [0, 3], 3, config) == ([], [0, 3])  # made with keyframe 1: two keyframes later they still have time
    assert failed_trial(editor, [0, 3], 4, config) == ([0], [])  # landmark 3 has its three observations and has passed
    editor.remove_landmarks([0])
    assert failed_trial(editor, [0, 1], 4, config) == ([1], [])


def test_the_trial_of_the_default_configuration_can_be_failed(editor: MapEditor) -> None:
    """A landmark that nobody but its two creators ever saw is what the trial is for (ORB-SLAM3: more than two observations)."""
    remove, _ = failed_trial(editor, [0, 1, 2, 3], 20, MappingConfig())
    assert remove == [0, 1, 2]


# ---- keyframes ----------------------------------------------------------------------------------------------------------------------


def row_of_keyframes(count: int, seen_by: list[list[int]], x: list[float] | None = None) -> MapEditor:
    """Keyframes at x; landmark i, four units ahead of the origin, is seen by the keyframes `seen_by[i]`."""
    editor = MapEditor(0, CAMERA, 1)
    for number in range(count):
        editor.add_keyframe(keyframe(number, count=20))
        editor.map.keyframes[number].world_from_camera = poses.transform(np.eye(3), [x[number] if x else 0.0, 0, 0])
    for feature, (landmark, observers) in enumerate(zip(editor.add_landmarks(np.tile([0.0, 0, 4], (len(seen_by), 1)), 0).tolist(), seen_by, strict=True)):
        for number in observers:
            editor.observe(landmark, number, feature)
    for number in range(count):
        editor.connect(number)
    return editor


def test_redundancy_is_the_share_that_three_others_see() -> None:
    editor = row_of_keyframes(5, [[0, 1, 2, 3], [0, 1, 2, 3, 4], [0, 1, 2], [1, 2]])
    assert redundancy(editor, 0, 3) == pytest.approx(2 / 3)
    assert redundancy(editor, 4, 3) == 1.0
    assert redundancy(editor, 0, 2) == 1.0


def test_one_that_sees_from_farther_off_is_no_replacement() -> None:
    """Keyframe 3 is 5 from the points, the others 4; 5 / 4 is more than one step of 1.2."""
    editor = row_of_keyframes(4, [[0, 1, 2, 3]] * 3, x=[0.0, 0.0, 0.0, 3.0])
    assert redundancy(editor, 0, 3) == 0.0
    assert redundancy(editor, 3, 3) == 1.0


def test_redundant_keyframes_leave_and_the_oldest_and_newest_stay() -> None:
    count = 12
    editor = row_of_keyframes(count, [list(range(count))] * 6)
    assert remove_redundant(editor, count - 1, MappingConfig(redundant_from=count)) == []
    removed = remove_redundant(editor, count - 1, MappingConfig(redundant_from=2))
    assert removed == list(range(1, count - NEWEST_KEPT))
    assert sorted(editor.map.keyframes) == [0, *range(count - NEWEST_KEPT, count)]
    assert len(editor.map.landmarks) == 6, "what they saw is still there"


def test_needed_keyframes_stay_until_the_budget_is_spent() -> None:
    """Pairs that see the same: none is redundant, but a map may not grow without end."""
    pairs = [[i, i + 1] for i in range(0, 30, 2)]
    editor = row_of_keyframes(30, [*pairs, [20, 21, 22, 23]])
    assert remove_redundant(editor, 29, MappingConfig(redundant_from=2, max_keyframes=30)) == []
    removed = remove_redundant(editor, 29, MappingConfig(redundant_from=2, max_keyframes=24))
    assert len(removed) == 6 and not {0, 25, 26, 27, 28, 29} & set(removed)
    assert removed == remove_redundant(row_of_keyframes(30, [*pairs, [20, 21, 22, 23]]), 29, MappingConfig(redundant_from=2, max_keyframes=24))
