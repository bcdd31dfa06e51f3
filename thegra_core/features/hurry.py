"""A network in a hurry: on all cores for one call."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from thegra_core.features.protocols import Matcher
from thegra_core.messages import Features, Matches


class Hurried:
    """`Matcher` that lets another one have `threads` threads while it matches: a camera that is sought makes no keyframes, and mapping leaves its core idle."""

    def __init__(self, inner: Matcher, threads: int) -> None:
        self.name = inner.name
        self._inner = inner
        self._threads = threads

    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`."""
        with _threads(self._threads):
            return self._inner.match(query, reference)

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        with _threads(self._threads):
            return self._inner.match_many(query, references)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
