"""Tracking and mapping for tests, wired as the system wires them."""

from __future__ import annotations

import numpy as np
from synthetic import CAMERA, FakeMatcher, World, observe, stamp

from thegra_core.config import ThegraConfig
from thegra_core.geometry.alignment import umeyama
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import Features, MapUpdate, TrackingState
from thegra_core.optimization.solver import BundleSolver
from thegra_core.tracking.stage import TrackingOutput, TrackingStage

CONFIG = ThegraConfig()


class Pair:
    """Tracking and mapping as `Slam` wires them, with every output kept."""

    def __init__(self, config: ThegraConfig = CONFIG, matcher: FakeMatcher | None = None, solver: BundleSolver | None = None) -> None:
        self.matcher = matcher or FakeMatcher()
        self.tracking = TrackingStage(CAMERA, config, self.matcher)
        self.mapper = Mapper(CAMERA, config, self.matcher, solver)
        self.outputs: list[TrackingOutput] = []
        self.updates: list[MapUpdate] = []

    def see(self, features: Features) -> TrackingOutput:
        reference = self.tracking.reference_features
        output = self.tracking.process(features, None if reference is None else self.matcher.match(features, reference))
        if output.dropped_map_id is not None:
            self.mapper.drop(output.dropped_map_id)
        update = None
        if output.initial_map is not None:
            update = self.mapper.initialize(output.initial_map)
        elif output.keyframe is not None:
            update = self.mapper.insert(output.keyframe)
        if update is not None:
            self.tracking.apply(update)
            self.updates.append(update)
        self.outputs.append(output)
        return output

    def run(self, world: World, path: list[np.ndarray], begin: int = 0, noise_px: float = 0.3) -> None:
        for index, pose in enumerate(path, start=begin):
            self.see(observe(world, pose, stamp(index), noise_px, 0.9, 10))


def position_error(outputs: list[TrackingOutput], path: list[np.ndarray]) -> tuple[float, int]:
    """Root mean square of positions after a similarity alignment over the length of the path, and how many frames had one."""
    pairs = [(o.result.world_from_camera[:3, 3], p[:3, 3]) for o, p in zip(outputs, path, strict=True) if o.result.state is TrackingState.TRACKING]
    found, true = np.array([a for a, _ in pairs]), np.array([b for _, b in pairs])
    scale, rotation, translation = umeyama(found, true)
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    return float(np.sqrt(((scale * found @ rotation.T + translation - true) ** 2).sum(axis=1).mean()) / length), len(pairs)
