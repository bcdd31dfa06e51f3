"""A matcher that may use more threads while it matches."""

from __future__ import annotations

import numpy as np
import torch

from thegra_core.features.hurry import Hurried
from thegra_core.messages import Features, Matches


class Counting:
    """Notes how many threads torch has when it is asked."""

    name = "counting"

    def __init__(self) -> None:
        self.threads: list[int] = []

    def match(self, query: Features, reference: Features) -> Matches:
        self.threads.append(torch.get_num_threads())
        return Matches(query.stamp_ns, reference.stamp_ns, np.empty((0, 2), np.int32), np.empty(0, np.float32))

    def match_many(self, query: Features, references: list[Features]) -> list[Matches]:
        return [self.match(query, reference) for reference in references]


def test_the_threads_are_there_while_it_matches_and_no_longer() -> None:
    features = Features(1, np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 4), np.float32), (64, 48), "x")
    inner, before = Counting(), torch.get_num_threads()
    hurried = Hurried(inner, before + 1)
    hurried.match(features, features)
    assert len(hurried.match_many(features, [features, features])) == 2
    assert inner.threads == [before + 1] * 3 and torch.get_num_threads() == before
