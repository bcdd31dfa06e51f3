"""Pose graph over similarities: what a loop says is spread over the keyframes between (Strasdat et al. 2010), on gtsam's C++ factors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from thegra_core.geometry import poses
from thegra_core.geometry.similarity import Similarity

ROTATION_SIGMA, SCALE_SIGMA = 0.01, 0.01
"""Standard deviations (rad; share) of an edge. Only their ratio to each other and to the translation's matters."""
FIXED_SIGMA = 1e-6


@dataclass(frozen=True, slots=True)
class Edge:
    """What is known of two nodes: first_from_second."""

    first: int
    second: int
    first_from_second: Similarity


def optimize_pose_graph(nodes: Mapping[int, Similarity], edges: Sequence[Edge], fixed: int, length: float) -> dict[int, Similarity]:
    """World_from_node of every node, least squares over all edges; one node stays.

    length: map units that weigh like a radian, as the scene's depth does.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas = np.array([ROTATION_SIGMA] * 3 + [ROTATION_SIGMA * length] * 3 + [SCALE_SIGMA])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    for node, world_from_node in nodes.items():
        values.insert(X(node), _to_gtsam(world_from_node))
    for edge in edges:
        graph.add(gtsam.BetweenFactorSimilarity3(X(edge.first), X(edge.second), _to_gtsam(edge.first_from_second), noise))
    graph.add(gtsam.PriorFactorSimilarity3(X(fixed), _to_gtsam(nodes[fixed]), gtsam.noiseModel.Isotropic.Sigma(7, FIXED_SIGMA)))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return {node: _from_gtsam(result.atSimilarity3(X(node))) for node in nodes}


def _to_gtsam(similarity: Similarity) -> gtsam.Similarity3:
    """gtsam's maps x to scale * (R x + t)."""
    return gtsam.Similarity3(similarity.rigid[:3, :3], similarity.rigid[:3, 3] / similarity.scale, similarity.scale)


def _from_gtsam(similarity: gtsam.Similarity3) -> Similarity:
    scale = float(similarity.scale())
    rotation = poses.nearest_rotation(similarity.rotation().matrix())
    return Similarity(poses.transform(rotation, scale * np.asarray(similarity.translation())), scale)
