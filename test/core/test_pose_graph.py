"""Similarities and the pose graph over them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from thegra_core.geometry import poses
from thegra_core.geometry.similarity import Similarity
from thegra_core.optimization.pose_graph import Edge, optimize_pose_graph

VECTORS = st.tuples(*[st.floats(-3, 3)] * 3)
SIMILARITIES = st.builds(lambda r, t, s: Similarity(poses.transform(poses.so3_exp(r), t), s), VECTORS, VECTORS, st.floats(0.2, 5))


def test_similarity_by_hand():
    a_from_b = Similarity(poses.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1.0, 2, 3]), 2.0)
    np.testing.assert_allclose(a_from_b.apply(np.array([[1.0, 0, 0], [0, 1, 5]])), [[1, 4, 3], [-1, 2, 13]], atol=1e-12)


@given(SIMILARITIES, SIMILARITIES, VECTORS)
def test_similarities_compose_and_invert(a_from_b, b_from_c, point):
    points = np.array([point])
    np.testing.assert_allclose((a_from_b @ b_from_c).apply(points), a_from_b.apply(b_from_c.apply(points)), atol=1e-9)
    np.testing.assert_allclose(a_from_b.inverse().apply(a_from_b.apply(points)), points, atol=1e-9)


def circle(count=24, drift=1.0):
    """A square-ish round trip, and what odometry makes of it when every step is `drift` times as long as the one before."""
    truth = [Similarity(poses.transform(poses.so3_exp([0, a, 0]), [4 * np.sin(a), 0, 4 * np.cos(a)])) for a in np.linspace(0, 2 * np.pi, count)]
    steps = [first.inverse() @ second for first, second in pairwise(truth)]
    scaled = [Similarity(step.rigid, drift) for step in steps]
    odometry = [truth[0]]
    for step in scaled:
        odometry.append(odometry[-1] @ step)
    return truth, [Similarity(node.rigid) for node in odometry]


def test_a_loop_takes_scale_drift_out():
    truth, drifted = circle(drift=1.01)
    assert np.linalg.norm(drifted[-1].rigid[:3, 3] - truth[-1].rigid[:3, 3]) > 0.3
    nodes = dict(enumerate(drifted))
    edges = [Edge(i, i + 1, drifted[i].inverse() @ drifted[i + 1]) for i in range(len(drifted) - 1)]
    seen_again = truth[0].inverse() @ Similarity(truth[-1].rigid, 1.01 ** -(len(truth) - 1))
    found = optimize_pose_graph(nodes, [*edges, Edge(0, len(drifted) - 1, seen_again)], fixed=0, length=4.0)
    np.testing.assert_allclose(found[0].rigid, truth[0].rigid, atol=1e-6)
    before = [np.linalg.norm(node.rigid[:3, 3] - true.rigid[:3, 3]) for node, true in zip(drifted, truth, strict=True)]
    after = [np.linalg.norm(found[i].rigid[:3, 3] - true.rigid[:3, 3]) for i, true in enumerate(truth)]
    assert max(after) < 0.35 * max(before)
    assert found[len(truth) - 1].scale < 0.85


def test_edges_that_hold_move_nothing():
    truth, _ = circle()
    edges = [Edge(i, i + 1, truth[i].inverse() @ truth[i + 1]) for i in range(len(truth) - 1)]
    for i, node in optimize_pose_graph(dict(enumerate(truth)), edges, fixed=3, length=4.0).items():
        np.testing.assert_allclose(node.rigid, truth[i].rigid, atol=1e-6)
        np.testing.assert_allclose(node.scale, 1, atol=1e-6)
