from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thegra_core.evaluation.benchmark.comparison import Scored, compare, sentences

T_3 = 3.182446305
"""97.5 % of Student's t with 3 degrees of freedom, as tables give it."""


def scored(label: str, *errors: float | None, tracked_pct: float = 100.0) -> list[Scored]:
    return [Scored(f"r{i}", label, tracked_pct, error) for i, error in enumerate(errors)]


def test_the_mean_of_ratios_and_how_sure_it_is() -> None:
    (found,) = compare([*scored("old", 1.0, 2.0, 4.0, 0.5), *scored("new", 2.0, 4.0, 4.0, 0.5, tracked_pct=90.0)], "old")
    logs = np.log([2.0, 2.0, 1.0, 1.0])
    half = T_3 * np.std(logs, ddof=1) / 2
    assert (found.label, found.against, found.recordings, found.without_error, found.tracked_pct) == ("new", "old", 4, 0, (90.0, 100.0))
    assert found.ratio == pytest.approx(np.sqrt(2))
    assert found.between == pytest.approx((np.sqrt(2) * np.exp(-half), np.sqrt(2) * np.exp(half)))


def test_only_recordings_of_both_count_and_missing_errors_are_told() -> None:
    results = [*scored("old", 1.0, None, 4.0), *scored("new", 3.0, 3.0, None, 3.0), Scored("elsewhere", "third", 100.0, 1.0)]
    (found,) = compare(results, "old")
    assert (found.recordings, found.without_error, found.ratio, found.between) == (3, 2, pytest.approx(3.0), None)
    assert sentences([asdict(found)]) == [
        "ATE of new over that of old: 3.00, geometric mean of 1 recordings, without 2 where one has no error; tracked 100.0 and 100.0 %."
    ]


def test_nothing_to_compare() -> None:
    assert compare([], "old") == compare(scored("old", 1.0), "old") == compare(scored("new", 1.0), "old") == []
    (found,) = compare([*scored("old", None), *scored("new", 1.0)], "old")
    assert (found.ratio, found.between) == (None, None)
    assert "no ratio, geometric mean of 0 recordings, without 1" in str(found)


@given(st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=8), st.floats(1e-2, 1e2))
def test_errors_that_are_all_larger_by_a_factor_are_larger_by_it_for_sure(errors: list[float], factor: float) -> None:
    (found,) = compare([*scored("old", *errors), *scored("new", *(factor * e for e in errors))], "old")
    assert found.between is not None
    assert (found.ratio, *found.between) == pytest.approx((factor,) * 3, rel=1e-6)


@given(st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3)), min_size=2, max_size=8))
def test_the_other_way_round_it_is_the_reciprocal(pairs: list[tuple[float, float]]) -> None:
    results = [*scored("a", *(a for a, _ in pairs)), *scored("b", *(b for _, b in pairs))]
    ((one,), (other,)) = compare(results, "a"), compare(results, "b")
    assert one.ratio == pytest.approx(1 / other.ratio)
    assert one.between == pytest.approx((1 / other.between[1], 1 / other.between[0]))
