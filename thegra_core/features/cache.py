"""Results of extractors and matchers kept on disk by content, so that runs that differ only behind the front end do not pay for the networks again.

An entry's key is everything the result depends on: the image's or the features' bytes, all settings, the weights' SHA-256, the versions of the
libraries and this package's own source. Stamps are no part of it; they are set on return. An entry made with device `auto` counts for whatever
device that was.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import logging
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ExtractorConfig, MatcherConfig
from thegra_core.features.protocols import Extractor, Matcher
from thegra_core.features.registry import EXTRACTOR_WEIGHTS, make_extractor, make_matcher, matcher_name, weights_for
from thegra_core.features.weights import path_of, sha256_of
from thegra_core.messages import Features, Matches

_log = logging.getLogger(__name__)
Arrays = dict[str, NDArray[Any]]
FEATURE_ARRAYS = ("keypoints", "scores", "descriptors", "image_size", "extractor")
MATCH_ARRAYS = ("indices", "confidence")
_LIBRARIES = ("numpy", "opencv-python-headless", "torch", "kornia")
_NOT_RESULTS = ("cache.py", "download.py", "weights.py")
_DAMAGE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


class Store:
    """Entries of one kind: each a file of named arrays under its key, whole or not there. Counts what it answered (`hits`) and what it had computed (`misses`)."""

    def __init__(self, folder: Path) -> None:
        self.hits = self.misses = 0
        self._folder = folder
        self._writable = True

    def get(self, key: str, compute: Callable[[], Arrays], names: Sequence[str]) -> Arrays:
        """The entry's arrays `names`; computed and kept if it is absent or damaged. A folder that cannot be written is said once and then does without."""
        path = self._folder / key[:2] / f"{key}.npz"
        try:
            found = _load(path, names)
        except (FileNotFoundError, NotADirectoryError):
            pass
        except _DAMAGE as error:
            _log.warning("the cache's entry %s is damaged (%s: %s); computed anew", path, type(error).__name__, error)
        else:
            self.hits += 1
            return found
        self.misses += 1
        arrays = compute()
        if self._writable:
            try:
                _save(path, arrays)
            except OSError as error:
                self._writable = False
                _log.warning("results are not kept: cannot write %s: %s", path, error.strerror or error)
        return arrays


class CachedExtractor:
    """`Extractor` that asks another one only for images it has not seen; that one is built at the first such image.

    Args:
        make: Builds the extractor behind.
        settings: JSON-able; all that the result depends on besides the image. `name` is the extractor's name.
        folder: Where the entries lie, shared by all settings; made when needed.
    """

    def __init__(self, make: Callable[[], Extractor], settings: Mapping[str, Any], folder: Path) -> None:
        self.name = str(settings["name"])
        self._inner = functools.cache(make)
        self._settings = _digest_of_settings(settings)
        self.store = Store(folder / "features")

    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        found = self.store.get(_key(self._settings, [image]), lambda: _feature_arrays(self._inner().extract(image, stamp_ns)), FEATURE_ARRAYS)
        width, height = found["image_size"].tolist()
        return Features(stamp_ns, found["keypoints"], found["scores"], found["descriptors"], (width, height), found["extractor"].tobytes().decode())


class CachedMatcher:
    """`Matcher` that asks another one only for pairs it has not seen; arguments as for `CachedExtractor`."""

    def __init__(self, make: Callable[[], Matcher], settings: Mapping[str, Any], folder: Path) -> None:
        self.name = str(settings["name"])
        self._inner = functools.cache(make)
        self._settings = _digest_of_settings(settings)
        self.store = Store(folder / "matches")

    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`."""
        arrays = [*_feature_arrays(query).values(), *_feature_arrays(reference).values()]
        found = self.store.get(_key(self._settings, arrays), lambda: _match_arrays(self._inner().match(query, reference)), MATCH_ARRAYS)
        return Matches(query.stamp_ns, reference.stamp_ns, found["indices"], found["confidence"])

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        return [self.match(query, reference) for reference in references]


def cached_extractor(config: ExtractorConfig, folder: Path) -> CachedExtractor:
    """`make_extractor` behind a cache.

    Raises:
        WeightsError: If its weights are not there.
    """
    settings = config.model_dump(mode="json") | _circumstances(EXTRACTOR_WEIGHTS[config.name])
    return CachedExtractor(lambda: make_extractor(config), settings, folder)


def cached_matcher(config: MatcherConfig, extractor: ExtractorConfig, folder: Path) -> CachedMatcher:
    """`make_matcher` behind a cache.

    Raises:
        ConfigError: If the matcher is unknown or does not fit the extractor.
        WeightsError: If its weights are not there.
    """
    name = matcher_name(config, extractor)
    weights = weights_for(extractor, config)[len(EXTRACTOR_WEIGHTS[extractor.name]) :]
    settings = config.model_dump(mode="json") | {"name": name, "extractor": extractor.name} | _circumstances(weights)
    return CachedMatcher(lambda: make_matcher(config, extractor), settings, folder)


def _circumstances(weights: Sequence[str]) -> dict[str, Any]:
    """What a result depends on besides its input and settings."""
    return {"weights": [_weights_digest(name) for name in weights], "libraries": _versions(), "source": _source_digest()}


def _weights_digest(name: str) -> str:
    return sha256_of(path_of(name))


@functools.cache
def _versions() -> dict[str, str | None]:
    return {name: _version(name) for name in _LIBRARIES}


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


@functools.cache
def _source_digest() -> str:
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        if file.name not in _NOT_RESULTS:
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _digest_of_settings(settings: Mapping[str, Any]) -> bytes:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).digest()


def _key(settings: bytes, arrays: Iterable[NDArray[Any]]) -> str:
    digest = hashlib.sha256(settings)
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data if array.size else b"")
    return digest.hexdigest()


def _feature_arrays(features: Features) -> Arrays:
    return {
        "keypoints": features.keypoints,
        "scores": features.scores,
        "descriptors": features.descriptors,
        "image_size": np.array(features.image_size, np.int64),
        "extractor": np.frombuffer(features.extractor.encode(), np.uint8),
    }


def _match_arrays(matches: Matches) -> Arrays:
    return {"indices": matches.indices, "confidence": matches.confidence}


def _load(path: Path, names: Sequence[str]) -> Arrays:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as entry:
        return {name: entry[name] for name in names}


def _save(path: Path, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
