"""Matches through a common keyframe, by hand and as a property."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from thegra_core.mapping.chaining import MatchGraph, compose, join, reversed_matches
from thegra_core.messages import Matches


def made(pairs: list[tuple[int, int]], query: int = 1, reference: int = 0, confidence: list[float] | None = None) -> Matches:
    values = confidence if confidence is not None else [1.0] * len(pairs)
    return Matches(query, reference, np.array(pairs, np.int32).reshape(-1, 2), np.array(values, np.float32))


def pairs_of(matches: Matches) -> list[tuple[int, int]]:
    return [(int(q), int(r)) for q, r in matches.indices]


def test_composition_by_hand() -> None:
    first = made([(0, 5), (1, 3), (4, 9)], 30, 20, [0.5, 0.8, 1.0])
    second = made([(3, 7), (5, 2), (6, 6)], 20, 10, [0.5, 0.4, 1.0])
    chained = compose(first, second)
    assert pairs_of(chained) == [(0, 2), (1, 7)]
    np.testing.assert_allclose(chained.confidence, [0.2, 0.4])
    assert (chained.stamp_ns, chained.reference_stamp_ns) == (30, 10)
    assert pairs_of(compose(made([]), second)) == pairs_of(compose(first, made([]))) == []


def test_joining_keeps_the_surer_and_stays_one_to_one() -> None:
    joined = join([made([(0, 1), (2, 3)], confidence=[0.5, 0.9]), made([(0, 4), (5, 3), (6, 7)], confidence=[0.7, 0.8, 0.1])])
    assert pairs_of(joined) == [(0, 4), (2, 3), (6, 7)]
    np.testing.assert_allclose(joined.confidence, [0.7, 0.9, 0.1])


one_to_one = st.permutations(range(8)).flatmap(lambda p: st.integers(0, 8).map(lambda n: [(i, p[i]) for i in range(n)]))


@given(one_to_one, one_to_one)
def test_composition_is_that_of_functions(a: list[tuple[int, int]], b: list[tuple[int, int]]) -> None:
    first, second = dict(a), dict(b)
    expected = {q: second[m] for q, m in first.items() if m in second}
    assert dict(pairs_of(compose(made(a), made(b)))) == expected
    back = compose(reversed_matches(made(b)), reversed_matches(made(a)))
    assert {r: q for q, r in pairs_of(back)} == expected
    assert pairs_of(reversed_matches(reversed_matches(made(a)))) == sorted(a)


def test_a_graph_tells_what_lies_two_matches_away() -> None:
    graph = MatchGraph()
    graph.add(1, 0, made([(0, 0), (1, 1), (2, 2)]))
    graph.add(2, 0, made([(0, 2)]))  # 2 and 1 meet in 0
    graph.add(3, 1, made([(4, 0), (5, 1)]))
    graph.add(3, 2, made([(6, 0)]))
    assert [(other, pairs_of(m)) for other, m in graph.chained(3, 5)] == [(0, [(4, 0), (5, 1), (6, 2)])]
    assert [other for other, _ in graph.chained(1, 5)] == [2]
    assert graph.chained(3, 0) == [] and graph.chained(99, 5) == []
    graph.add(4, 3, made([(0, 6)]))
    assert [(other, pairs_of(m)) for other, m in graph.chained(4, 5)] == [(2, [(0, 0)])], "keyframe 1 is two matches away, but no keypoint goes all the way"


def test_a_removed_keyframe_leaves_no_matches() -> None:
    graph = MatchGraph()
    for one, other in ((1, 0), (2, 1), (3, 2)):
        graph.add(one, other, Matches(one, other, np.array([[0, 0], [1, 1]], np.int32), np.ones(2, np.float32)))
    assert [far for far, _ in graph.chained(3, 9)] == [1]
    graph.remove(2)
    graph.remove(7)
    assert graph.chained(3, 9) == [] and graph.chained(1, 9) == []
    assert graph.arrays()["edges"].tolist() == [[1, 0]]
