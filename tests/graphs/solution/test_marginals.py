"""Marginal covariances, against the dense inverse."""

import tracemalloc

import jax
import numpy as np
import pytest
import small_graphs
from pose_rings import SIZE, dense, ring
from reference import graph as plain
from small_graphs import POINTS, POSES

from jaxslam import graphs
from jaxslam.graphs.sparse.sweeps import Sums, places, sweep


def as_it_is(graph):
    """The solution that the graph is, without a step."""
    return graphs.optimize(graph, iterations=0)


def test_marginals_are_the_blocks_of_the_dense_inverse():
    graph = ring()
    pairs = [[3, 4], [9, 2], [7, 19]]  # along an edge, none, none and turned round
    poses, _, information, _ = dense(graph)
    found = graphs.marginals(as_it_is(graph._replace(poses=poses)), pairs=pairs)
    cov = np.zeros((SIZE, 3, SIZE, 3))
    cov[1:, :, 1:] = np.linalg.inv(information).reshape(SIZE - 1, 3, SIZE - 1, 3)
    scale = np.abs(cov).max()
    for k in range(SIZE):
        np.testing.assert_allclose(found.poses[k], cov[k, :, k], atol=1e-9 * scale)
    for joint, (a, b) in zip(found.pairs, pairs, strict=True):
        both = [[cov[a, :, a], cov[a, :, b]], [cov[b, :, a], cov[b, :, b]]]
        np.testing.assert_allclose(joint, np.array(both), atol=1e-9 * scale)
    assert found.singular == -1


def test_those_of_points_and_of_poses_with_points_are_too():
    """With every kind of measurement; J by differences of the sixth order."""
    graph = small_graphs.drawn(noise=0.1)
    # A point seen from the pose, one that is not, turned round, two points, a fixed pose.
    pairs = [[1, POSES + 1], [1, POSES], [POSES + 2, 4], [POSES, POSES + 2], [0, POSES]]
    residuals, at, _ = plain.whitened(graph)
    step = 1e-2 * np.eye(len(at))
    sides = zip((1, 2, 3), (3 / 4, -3 / 20, 1 / 60), strict=True)
    jacobian = sum(
        w / 1e-2 * np.array([residuals(at + k * h) - residuals(at - k * h) for h in step]).T
        for k, w in sides
    )
    inverse, free = np.linalg.inv(jacobian.T @ jacobian), 3 * (POSES - 1)
    # Rows and columns of the fixed pose, and of the third number that a point does not have.
    place = np.r_[3 : 3 * POSES, (3 * np.arange(POSES, POSES + POINTS)[:, None] + [0, 1]).ravel()]
    count = POSES + POINTS
    cov = np.zeros((3 * count, 3 * count))
    cov[np.ix_(place, place)] = inverse
    cov = cov.reshape(count, 3, count, 3)
    with pytest.raises(ValueError, match=f"from 0 to {count - 1}, got"):
        graphs.marginals(
            as_it_is(graph), pairs=[[0, count]]
        )  # of the padded graph it is a variable
    found = graphs.marginals(as_it_is(graph), pairs=pairs)
    atol = 1e-9 * np.abs(inverse).max()
    for k in range(POINTS):
        np.testing.assert_allclose(found.points[k], cov[POSES + k, :2, POSES + k, :2], atol=atol)
    assert np.abs(inverse[:free, free:]).max() > 1e3 * atol
    for joint, (a, b) in zip(found.pairs, pairs, strict=True):
        both = [[cov[a, :, a], cov[a, :, b]], [cov[b, :, a], cov[b, :, b]]]
        np.testing.assert_allclose(joint, np.array(both), atol=atol)


@pytest.mark.parametrize("pairs", [(1, 2), [[1, 2, 3], [4, 5, 6]], [[1.5, 2.0]]])
def test_pairs_are_two_whole_numbers_each(pairs):
    """A table on its side would else be read as other pairs."""
    with pytest.raises(ValueError, match=r"expected pairs of whole numbers, \(Q, 2\), got"):
        graphs.marginals(as_it_is(ring()), pairs=pairs)


def test_tables_of_sums_take_little_more_memory_than_they_hold_in_the_end():
    # A plan with marginals of 15,000 poses has nine million products.
    rng, targets, products = np.random.default_rng(0), 4_000, 1_000_000
    numbers = rng.integers(0, targets, (3, products)).astype(np.int32)
    sums = Sums(np.sort(rng.integers(0, 20, targets)), *numbers, rng.random(products) < 0.5)
    _, place = places(sums, targets)
    tracemalloc.start()
    try:
        tables = sweep(sums, place, place, place)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3 * sum(part.nbytes for part in jax.tree.leaves(tables))
