from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thegra_core.config import ExtractorConfig, MatcherConfig
from thegra_core.errors import WeightsError
from thegra_core.features.cache import CachedExtractor, CachedMatcher, cached_extractor, cached_matcher
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.messages import Features, Matches

ORB = ExtractorConfig(name="orb", max_keypoints=200)
NEAREST = MatcherConfig(name="nearest")


def picture(seed: int) -> np.ndarray:
    return np.kron(np.random.default_rng(seed).integers(0, 255, (24, 32), dtype=np.uint8), np.ones((5, 5), np.uint8))


def content(made: Features | Matches) -> list[tuple]:
    """Everything of it, exactly: bytes, types, shapes and layout in memory."""
    values = [getattr(made, name) for name in made.__slots__]
    return [(v.tobytes(), v.dtype, v.shape, v.flags.c_contiguous) if isinstance(v, np.ndarray) else (v,) for v in values]


def never() -> None:
    raise AssertionError("the network was built although its result is there")


def entries(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.npz"))


@pytest.mark.parametrize("config", [ORB, ExtractorConfig(name="sift", max_keypoints=100)], ids=lambda c: c.name)
def test_features_from_the_cache_are_those_without_it(tmp_path: Path, config: ExtractorConfig) -> None:
    plain, cached = make_extractor(config), cached_extractor(config, tmp_path)
    expected = content(plain.extract(picture(0), 7))
    assert content(cached.extract(picture(0), 7)) == expected
    again = cached_extractor(config, tmp_path)
    assert content(again.extract(picture(0), 7)) == expected
    assert [(c.store.hits, c.store.misses) for c in (cached, again)] == [(0, 1), (1, 0)]
    assert again.name == plain.name


def test_the_stamp_is_no_part_of_the_key(tmp_path: Path) -> None:
    cached = cached_extractor(ORB, tmp_path)
    first, second = (cached.extract(picture(0), stamp) for stamp in (1, 2))
    assert (first.stamp_ns, second.stamp_ns, cached.store.hits) == (1, 2, 1)
    matcher = cached_matcher(NEAREST, ORB, tmp_path)
    assert [matcher.match(first, first).stamp_ns, matcher.match(second, first).stamp_ns] == [1, 2]
    assert matcher.store.hits == 1


def test_matches_from_the_cache_are_those_without_it(tmp_path: Path) -> None:
    a, b, c = (make_extractor(ORB).extract(np.roll(picture(0), 3 * i, axis=1), i) for i in range(3))
    expected = [content(m) for m in make_matcher(NEAREST, ORB).match_many(a, [b, c])]
    for _ in range(2):
        assert [content(m) for m in cached_matcher(NEAREST, ORB, tmp_path).match_many(a, [b, c])] == expected
    assert len(entries(tmp_path)) == 2


def test_no_keypoints_and_no_matches_are_kept_too(tmp_path: Path) -> None:
    for _ in range(2):
        empty = cached_extractor(ORB, tmp_path).extract(np.zeros((60, 80), np.uint8), 0)
        matches = cached_matcher(NEAREST, ORB, tmp_path).match(empty, empty)
    assert (len(empty), empty.descriptors.shape, empty.descriptors.dtype) == (0, (0, 32), np.uint8)
    assert matches.indices.shape == (0, 2)
    assert len(entries(tmp_path)) == 2


def test_what_is_there_needs_no_network(tmp_path: Path) -> None:
    settings = {"name": "orb", "any": [1, 2]}
    CachedExtractor(lambda: make_extractor(ORB), settings, tmp_path).extract(picture(0), 0)
    features = CachedExtractor(never, settings, tmp_path).extract(picture(0), 0)  # type: ignore[arg-type]
    CachedMatcher(lambda: make_matcher(NEAREST, ORB), {"name": "nearest"}, tmp_path).match(features, features)
    assert len(CachedMatcher(never, {"name": "nearest"}, tmp_path).match(features, features)) > 50  # type: ignore[arg-type]
    with pytest.raises(AssertionError):
        CachedExtractor(never, settings, tmp_path).extract(picture(1), 0)  # type: ignore[arg-type]


def test_the_network_is_built_once(tmp_path: Path) -> None:
    built = []
    cached = CachedExtractor(lambda: built.append(1) or make_extractor(ORB), {"name": "orb"}, tmp_path)
    assert not built
    for seed in (0, 1, 0):
        cached.extract(picture(seed), 0)
    assert (len(built), cached.store.hits, cached.store.misses) == (1, 1, 2)


def test_other_content_and_other_settings_have_entries_of_their_own(tmp_path: Path) -> None:
    image = picture(0)
    one_off = image.copy()
    one_off[0, 0] ^= 1
    for config in (ORB, ORB.model_copy(update={"max_keypoints": 100})):
        for variant in (image, one_off, image.reshape(60, 320)):
            cached_extractor(config, tmp_path).extract(variant, 0)
    assert len(entries(tmp_path)) == 6
    features = make_extractor(ORB).extract(image, 0)
    stronger = replace(features, scores=features.scores * np.float32(0.5))
    larger = replace(features, image_size=(1000, 1000))
    for config in (NEAREST, MatcherConfig(name="nearest", ratio=0.7)):
        for query, reference in ((features, features), (features, stronger), (stronger, features), (larger, features)):
            cached_matcher(config, ORB, tmp_path).match(query, reference)
    assert len(entries(tmp_path / "matches")) == 8


@pytest.mark.parametrize("damage", [b"", b"no zip file", None], ids=["empty", "other", "cut"])
def test_a_damaged_entry_is_computed_anew(tmp_path: Path, damage: bytes | None) -> None:
    expected = content(cached_extractor(ORB, tmp_path).extract(picture(0), 0))
    (entry,) = entries(tmp_path)
    whole = entry.read_bytes()
    entry.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    cached = cached_extractor(ORB, tmp_path)
    assert content(cached.extract(picture(0), 0)) == expected
    assert cached.store.misses == 1
    assert content(cached_extractor(ORB, tmp_path).extract(picture(0), 0)) == expected
    assert [f.name for f in entry.parent.iterdir()] == [entry.name], "no temporary files stay"


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    expected = content(cached_extractor(ORB, tmp_path).extract(picture(0), 0))
    (entry,) = entries(tmp_path)
    data = bytearray(entry.read_bytes())
    data[data.index(b"keypoints") + 300] ^= 4
    entry.write_bytes(data)
    assert content(cached_extractor(ORB, tmp_path).extract(picture(0), 0)) == expected


def test_a_folder_that_cannot_be_written_does_no_harm(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    cached = cached_extractor(ORB, blocked)
    assert content(cached.extract(picture(0), 0)) == content(make_extractor(ORB).extract(picture(0), 0))
    cached.extract(picture(1), 0)
    assert sum("cannot write" in r.message for r in caplog.records) == 1


def test_missing_weights_are_told_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THEGRA_WEIGHTS", str(tmp_path))
    with pytest.raises(WeightsError, match="thegra weights fetch xfeat"):
        cached_extractor(ExtractorConfig(name="xfeat"), tmp_path)
    with pytest.raises(WeightsError, match="thegra weights fetch xfeat-lighterglue"):
        cached_matcher(MatcherConfig(), ExtractorConfig(name="xfeat"), tmp_path)
