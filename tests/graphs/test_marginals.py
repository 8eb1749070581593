"""Marginal covariances, against the dense inverse."""

import numpy as np
from pose_rings import SIZE, dense, ring

from jaxslam import graphs


def test_marginals_are_the_blocks_of_the_dense_inverse():
    graph = ring()
    pairs = [[3, 4], [9, 2], [7, 19]]  # along an edge, none, none and turned round
    poses, _, information, _ = dense(graph)
    found = graphs.marginals(graph._replace(poses=poses), pairs=pairs)
    cov = np.zeros((SIZE, 3, SIZE, 3))
    cov[1:, :, 1:] = np.linalg.inv(information).reshape(SIZE - 1, 3, SIZE - 1, 3)
    scale = np.abs(cov).max()
    for k in range(SIZE):
        np.testing.assert_allclose(found.poses[k], cov[k, :, k], atol=1e-9 * scale)
    for joint, (a, b) in zip(found.pairs, pairs, strict=True):
        both = [[cov[a, :, a], cov[a, :, b]], [cov[b, :, a], cov[b, :, b]]]
        np.testing.assert_allclose(joint, np.array(both), atol=1e-9 * scale)
    assert found.singular == -1
