"""The landmarks' arrays: ids stay what they are, whatever is added, changed, removed or compacted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thegra_core.map.landmarks import LandmarkStore
from thegra_core.messages import LandmarkArrays


def arrays(ids: list[int], salt: int = 0) -> LandmarkArrays:
    """Landmarks whose every column follows from id and salt."""
    base = np.array(ids, dtype=np.float64).reshape(-1, 1) + 0.001 * salt
    return LandmarkArrays(
        ids=np.array(ids, dtype=np.int64),
        points_world=base * [1, 2, 3],
        normals=base * [0, 0, 1],
        depth_min=base[:, 0],
        depth_max=2 * base[:, 0],
        descriptors=np.repeat(base, 4, axis=1).astype(np.float32),
        scores=base[:, 0].astype(np.float32),
    )


def same(found: LandmarkArrays, expected: LandmarkArrays) -> None:
    for name in ("ids", "points_world", "normals", "depth_min", "depth_max", "descriptors", "scores"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
        assert getattr(found, name).dtype == getattr(expected, name).dtype


def test_an_empty_store() -> None:
    store = LandmarkStore()
    assert len(store) == 0
    np.testing.assert_array_equal(store.rows(np.array([0, -1, 5])), [-1, -1, -1])
    assert store.rows(np.empty(0, np.int64)).shape == (0,)
    assert store.alive_ids().shape == (0,)
    store.remove(np.array([1, 2]))
    store.put(arrays([]))
    assert len(store) == 0


def test_put_get_overwrite_and_remove() -> None:
    store = LandmarkStore()
    store.put(arrays([2, 5, 9]))
    store.put(arrays([5, 11, 10], salt=1))  # one known, two new and out of order
    np.testing.assert_array_equal(store.alive_ids(), [2, 5, 9, 10, 11])
    same(store.get(np.array([10, 2])), LandmarkArrays(**{n: np.concatenate([getattr(arrays([10], 1), n), getattr(arrays([2]), n)]) for n in arrays([1]).__slots__}))
    same(store.get(np.array([5])), arrays([5], 1))
    store.remove(np.array([9, 9, 77, -1]))
    assert len(store) == 4
    np.testing.assert_array_equal(store.rows(np.array([9, -1, 77, 3])), [-1, -1, -1, -1])
    store.remove(np.array([9]))
    assert len(store) == 4


def test_what_is_got_is_a_copy() -> None:
    store = LandmarkStore()
    store.put(arrays([1, 2]))
    store.get(np.array([1])).points_world[:] = 99
    same(store.get(np.array([1])), arrays([1]))


def test_getting_the_dead_is_an_error_and_not_some_other_landmark() -> None:
    store = LandmarkStore()
    store.put(arrays([1, 2]))
    store.remove(np.array([1]))
    with pytest.raises(KeyError, match="1"):
        store.get(np.array([1, 2]))


def test_ids_survive_growth_and_compaction() -> None:
    store = LandmarkStore()
    for begin in range(0, 6000, 500):
        store.put(arrays(list(range(begin, begin + 500))))
    store.remove(np.arange(0, 6000, 2))
    store.remove(np.arange(1, 4000, 4))
    alive = np.setdiff1d(np.arange(1, 6000, 2), np.arange(1, 4000, 4))
    np.testing.assert_array_equal(store.alive_ids(), alive)
    same(store.get(alive), arrays(alive.tolist()))
    assert len(store.column("ids")) < 6000, "the dead were dropped"
    store.put(arrays([6000, 6001]))
    same(store.get(np.array([6001, 5999])), arrays([6001, 5999]))


def test_a_store_that_lost_everything_starts_again() -> None:
    store = LandmarkStore()
    store.put(arrays(list(range(2000))))
    store.remove(np.arange(2000))
    assert len(store) == 0 and store.alive_ids().shape == (0,)
    store.put(arrays([2000]))
    np.testing.assert_array_equal(store.alive_ids(), [2000])


def test_binary_descriptors_keep_their_type() -> None:
    store = LandmarkStore()
    binary = LandmarkArrays(np.array([3]), np.ones((1, 3)), np.ones((1, 3)), np.ones(1), np.ones(1), np.full((1, 32), 200, np.uint8), np.ones(1, np.float32))
    store.put(binary)
    same(store.get(np.array([3])), binary)


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.sampled_from(["add", "change", "remove"]), st.integers(0, 10**6), st.integers(1, 900)), max_size=25))
def test_it_behaves_like_a_dictionary(steps: list[tuple[str, int, int]]) -> None:
    store, model, following = LandmarkStore(), {}, 0
    for salt, (what, seed, count) in enumerate(steps):
        rng = np.random.default_rng(seed)
        if what == "add":
            ids = list(range(following, following + count))
            following += count
        else:
            ids = rng.permutation(following)[:count].tolist() if following else []
        if what == "remove":
            store.remove(np.array(ids, dtype=np.int64))
            for i in ids:
                model.pop(i, None)
        else:
            ids = [i for i in ids if what == "add" or i in model]
            store.put(arrays(ids, salt))
            model.update(dict.fromkeys(ids, salt))
        assert len(store) == len(model)
        alive = sorted(model)
        np.testing.assert_array_equal(store.alive_ids(), alive)
        if alive:
            expected = np.array(alive) + 0.001 * np.array([model[i] for i in alive])
            np.testing.assert_array_equal(store.get(np.array(alive)).depth_min, expected)
