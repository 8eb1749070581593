"""Loops: which agree, what looks alike, and covariances along a chain."""

import numpy as np
import pytest

from jaxslam import graphs
from jaxslam.laser.laser_slam import covariances
from jaxslam.laser.laser_slam.assembly import ROOM, graph_of, relative_covs, table_of
from jaxslam.laser.laser_slam.loops.candidates import SECTORS, descriptors
from jaxslam.laser.laser_slam.loops.pairwise import clique, consistent
from jaxslam.math import numpy_poses as poses


@pytest.fixture(scope="module")
def chain():
    """(path, covariances of its steps, sums of them)"""
    random = np.random.default_rng(2)
    steps = np.array([[1.0, 0.0, 0.3]] * 11) + 0.1 * random.normal(size=(11, 3))
    root = 0.05 * random.normal(size=(11, 3, 3))
    covs = root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(3)
    path = poses.chain(np.array([1.0, -2.0, 0.7]), steps)
    return path, steps, covs, covariances.along(path, covs)


def test_covariance_along_a_chain_step_by_step(chain):
    path, steps, covs, total = chain
    cov = np.zeros((3, 3))
    for k in range(4, 9):
        cov = covariances.composed_cov(cov, steps[k], covs[k])
    np.testing.assert_allclose(
        covariances.relative_cov(total, path, np.array(4), np.array(9)), cov, rtol=1e-9
    )
    z = poses.between(path[4], path[9])
    back = covariances.relative_cov(total, path, np.array(9), np.array(4))
    np.testing.assert_allclose(covariances.moved(cov, poses.inverse(z)), back, rtol=1e-9)
    np.testing.assert_allclose(
        covariances.at_end(covariances.of_coordinates(cov, z), z), cov, rtol=1e-9
    )


def test_covariance_along_a_chain_is_that_of_the_graph(chain):
    path, steps, covs, total = chain
    index = np.arange(len(path))
    graph = graph_of(path, index, table_of(index[:-1], index[1:], steps, covs))
    found = graphs.optimize(graph, room=ROOM, iterations=0)
    pairs = np.array([[2, 7], [0, 11]])
    np.testing.assert_allclose(
        relative_covs(found, pairs), covariances.relative_cov(total, path, *pairs.T), rtol=1e-6
    )


def test_a_false_loop_agrees_with_no_true_one(chain):
    path, _, _, total = chain
    random = np.random.default_rng(3)
    first, second = np.array([0, 1, 2, 3, 1]), np.array([8, 9, 10, 11, 10])
    cov = np.broadcast_to(1e-4 * np.eye(3), (5, 3, 3))
    z = poses.between(path[first], path[second]) + 0.01 * random.normal(size=(5, 3))
    z[4] += [3.0, -3.0, 0.8]
    agree = consistent(path, total, first, second, z, cov, 0.999)
    assert agree[:4, :4].all() and not agree[4, :4].any()
    assert (agree == agree.T).all()
    np.testing.assert_array_equal(clique(agree, np.ones(5)), [1, 1, 1, 1, 0])


def test_true_loops_agree_as_often_as_their_probability_says(chain):
    """Loops and odometry drawn from their covariances; independent, as the test assumes."""
    path, steps, covs, _ = chain
    random = np.random.default_rng(4)
    root = np.linalg.cholesky(1e-3 * covs)
    cov = np.broadcast_to(1e-6 * np.eye(3), (2, 3, 3))
    first, second, agreed = np.array([0, 3]), np.array([10, 8]), 0
    true = poses.between(path[first], path[second])
    for _ in range(300):
        error = (root @ random.normal(size=(11, 3, 1)))[..., 0]
        drawn = poses.chain(path[0], poses.compose(steps, error))
        z = poses.compose(true, 1e-3 * random.normal(size=(2, 3)))
        total = covariances.along(drawn, 1e-3 * covs)
        agreed += consistent(drawn, total, first, second, z, cov, 0.9)[0, 1]
    assert abs(agreed / 300 - 0.9) < 3 * np.sqrt(0.9 * 0.1 / 300)


def test_the_clique_is_one_and_large():
    random = np.random.default_rng(5)
    agree = random.random((60, 60)) < 0.4
    inside = np.arange(25)
    agree[np.ix_(inside, inside)] = True
    agree |= agree.T
    found = clique(agree, np.ones(60))
    assert found.sum() >= 25
    members = np.flatnonzero(found)
    assert (agree[np.ix_(members, members)] | np.eye(len(members), dtype=bool)).all()
    assert not clique(np.zeros((0, 0), bool), np.zeros(0)).any()


def test_a_descriptor_does_not_see_the_heading():
    random = np.random.default_rng(6)
    far, at = random.uniform(1, 10, (2, 80)), random.uniform(0, 2 * np.pi, (2, 80))
    turned = at + 2 * np.pi / SECTORS * 7

    def of(angle):
        points = far[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return descriptors(points, np.ones((2, 80), bool))

    np.testing.assert_allclose(of(at), of(turned), atol=1e-9)
    assert of(at)[0] @ of(at)[1] < 0.95
    assert not descriptors(np.zeros((1, 4, 2)), np.zeros((1, 4), bool)).any()
