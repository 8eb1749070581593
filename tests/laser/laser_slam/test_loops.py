"""Loops: which agree, what looks alike; covariances along a chain, and of relations by the graph."""

import dataclasses

import numpy as np
import pytest
from ring_of_rooms import SETTINGS, driven

from jaxslam import graphs, laser_slam, metrics
from jaxslam.laser.laser_slam import _assembly, _end_covariances, _score
from jaxslam.laser.laser_slam._loops import loop_candidates, pairwise
from jaxslam.math import numpy_poses as poses


@pytest.fixture(scope="module")
def chain():
    """(path, covariances of its steps, sums of them)"""
    random = np.random.default_rng(2)
    steps = np.array([[1.0, 0.0, 0.3]] * 11) + 0.1 * random.normal(size=(11, 3))
    root = 0.05 * random.normal(size=(11, 3, 3))
    covs = root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(3)
    path = poses.chain(np.array([1.0, -2.0, 0.7]), steps)
    return path, steps, covs, _end_covariances.along(path, covs)


def test_covariance_along_a_chain_step_by_step(chain):
    path, steps, covs, total = chain
    cov = np.zeros((3, 3))
    for k in range(4, 9):
        cov = _end_covariances.composed_cov(cov, steps[k], covs[k])
    np.testing.assert_allclose(
        _end_covariances.relative_cov(total, path, np.array(4), np.array(9)), cov, rtol=1e-9
    )
    z = poses.between(path[4], path[9])
    back = _end_covariances.relative_cov(total, path, np.array(9), np.array(4))
    np.testing.assert_allclose(_end_covariances.move(cov, poses.inverse(z)), back, rtol=1e-9)
    np.testing.assert_allclose(
        _end_covariances.at_end(_end_covariances.of_coordinates(cov, z), z), cov, rtol=1e-9
    )


def test_covariance_along_a_chain_is_that_of_the_graph(chain):
    path, steps, covs, total = chain
    index = np.arange(len(path))
    graph = _assembly.graph_of(path, index, _assembly.table_of(index[:-1], index[1:], steps, covs))
    solved = graphs.optimize(graph, room=_assembly.ROOM, iterations=0)
    pairs = np.array([[2, 7], [0, 11]])
    np.testing.assert_allclose(
        _assembly.relative_covs(solved, pairs),
        _end_covariances.relative_cov(total, path, *pairs.T),
        rtol=1e-6,
    )


def test_a_false_loop_agrees_with_no_true_one(chain):
    path, _, _, total = chain
    random = np.random.default_rng(3)
    first, second = np.array([0, 1, 2, 3, 1]), np.array([8, 9, 10, 11, 10])
    cov = np.broadcast_to(1e-4 * np.eye(3), (5, 3, 3))
    z = poses.between(path[first], path[second]) + 0.01 * random.normal(size=(5, 3))
    z[4] += [3.0, -3.0, 0.8]
    agree = pairwise.pairwise_consistency(path, total, first, second, z, cov, 0.999)
    assert agree[:4, :4].all() and not agree[4, :4].any()
    assert (agree == agree.T).all()
    np.testing.assert_array_equal(pairwise.clique(agree, np.ones(5)), [1, 1, 1, 1, 0])


@pytest.mark.sweep
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
        total = _end_covariances.along(drawn, 1e-3 * covs)
        agreed += pairwise.pairwise_consistency(drawn, total, first, second, z, cov, 0.9)[0, 1]
    assert abs(agreed / 300 - 0.9) < 3 * np.sqrt(0.9 * 0.1 / 300)


def test_the_clique_is_one_and_large():
    random = np.random.default_rng(5)
    agree = random.random((60, 60)) < 0.4
    inside = np.arange(25)
    agree[np.ix_(inside, inside)] = True
    agree |= agree.T
    solved = pairwise.clique(agree, np.ones(60))
    assert solved.sum() >= 25
    members = np.flatnonzero(solved)
    assert (agree[np.ix_(members, members)] | np.eye(len(members), dtype=bool)).all()
    assert not pairwise.clique(np.zeros((0, 0), bool), np.zeros(0)).any()


def test_a_descriptor_does_not_see_the_heading():
    random = np.random.default_rng(6)
    far, at = random.uniform(1, 10, (2, 80)), random.uniform(0, 2 * np.pi, (2, 80))
    turned = at + 2 * np.pi / loop_candidates.SECTORS * 7

    def of(angle):
        points = far[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return loop_candidates.descriptors(points, np.ones((2, 80), bool))

    np.testing.assert_allclose(of(at), of(turned), atol=1e-9)
    assert of(at)[0] @ of(at)[1] < 0.95
    assert not loop_candidates.descriptors(np.zeros((1, 4, 2)), np.zeros((1, 4), bool)).any()


# --- Covariances of relative poses by the graph, against dense NumPy, and relations of the true p--


@pytest.fixture(scope="module")
def drive():
    """(true path, result): every second scan is a keyframe."""
    true, log = driven()
    solved = laser_slam.solve(log, dataclasses.replace(SETTINGS, key_distance=1.5, loop_gap=8))
    assert solved.counts["loops kept"] >= 3
    return true, solved


def residuals(variables, graph):
    """Of all edges, each weighted by the root of its information."""
    at = np.concatenate([np.asarray(graph.poses[:1]), variables.reshape(-1, 3)])
    parts = []
    for table in graph.tables.values():
        valid = np.asarray(table.valid)
        i, j = np.asarray(table.who)[valid].T
        e = poses.between(np.asarray(table.z)[valid], poses.between(at[i], at[j]))
        root = np.swapaxes(np.linalg.cholesky(np.asarray(table.information)[valid]), 1, 2)
        parts.append((root @ e[..., None]).ravel())
    return np.concatenate(parts)


def derivatives(function, at, step=1e-6):
    """(m, n) by central differences."""
    steps = step * np.eye(len(at))
    return np.stack([(function(at + d) - function(at - d)) / (2 * step) for d in steps], axis=1)


def dense(solved, i, j):
    """The covariance of the end of x_i⁻¹ ∘ x_j: that of all keyframes and all scans on them,
    through one function of all."""
    graph = solved.graph
    at = np.asarray(graph.poses)
    free = at[1:].ravel()
    jacobian = derivatives(lambda v: residuals(v, graph), free)
    cov = np.zeros((len(free) + 6, len(free) + 6))
    cov[:-6, :-6] = np.linalg.inv(jacobian.T @ jacobian)
    cov[-6:-3, -6:-3], cov[-3:, -3:] = solved.z_cov[i], solved.z_cov[j]
    estimate = poses.between(solved.poses[i], solved.poses[j])

    def end(v):
        keys = np.concatenate([at[:1], v[:-6].reshape(-1, 3)])
        ends = poses.compose(solved.z[[i, j]], v[-6:].reshape(2, 3))
        x = poses.compose(keys[solved.base[[i, j]]], ends)
        return poses.between(estimate, poses.between(x[0], x[1]))

    by = derivatives(end, np.concatenate([free, np.zeros(6)]))
    return by @ cov @ by.T


@pytest.mark.sweep
def test_the_covariances_are_those_of_the_dense_inverse(drive, monkeypatch):
    _, solved = drive
    count = len(solved.poses)
    between = np.setdiff1d(np.arange(count), solved.keyframe)
    assert len(solved.keyframe) > 8 and len(between) > 8 and solved.base[3] == 1
    scans = np.arange(1, count)
    of_path = _end_covariances.of_coordinates(
        laser_slam.relation_covs(solved, 0 * scans, scans), solved.poses[1:]
    )
    np.testing.assert_allclose(of_path, solved.cov[1:], rtol=1e-6, atol=1e-12)
    # Scan 5 beside 3 on the keyframe 2.
    base, z, z_cov, path = (
        np.array(x) for x in (solved.base, solved.z, solved.z_cov, solved.poses)
    )
    base[5], z[5] = 1, [0.3, -0.2, 1.0]
    path[5] = poses.compose(path[2], z[5])
    solved = solved._replace(base=base, z=z, z_cov=z_cov, poses=path)
    ends = [0, *solved.keyframe[[3, -1]], 1, 3, 5, 39]
    pairs = np.array([(i, j) for i in ends for j in ends if i != j])
    monkeypatch.setattr(_score, "TOGETHER", 7)
    covs = laser_slam.relation_covs(solved, *pairs.T)
    for (i, j), cov in zip(pairs, covs, strict=True):
        np.testing.assert_allclose(cov, dense(solved, i, j), rtol=1e-6, atol=1e-6 * cov.max())


def test_the_error_of_a_relation_by_its_covariance(drive):
    true, solved = drive
    parts = [metrics.relations(true, rows=rows) for rows in (1, 3, 7, 24)]
    relations = metrics.Relations(*map(np.concatenate, zip(*parts, strict=True)))
    nees = laser_slam.relation_nees(solved, *relations)
    assert (nees < 7.81).mean() > 0.9 and 0.3 < nees.mean() < 6
    k = 40
    cov = laser_slam.relation_covs(solved, relations.first[k : k + 1], relations.second[k : k + 1])[
        0
    ]
    estimate = poses.between(solved.poses[relations.first[k]], solved.poses[relations.second[k]])
    e = 2 * np.linalg.cholesky(cov)[:, 1]
    off = relations._replace(pose=poses.compose(estimate, e)[None].repeat(len(nees), 0))
    assert laser_slam.relation_nees(solved, *off)[k] == pytest.approx(4)
    same = metrics.Relations(relations.first[:2], relations.first[:2], np.zeros((2, 3)))
    assert np.isnan(laser_slam.relation_nees(solved, *same)).all()


def test_scans_that_are_none_are_refused(drive):
    _, solved = drive
    for first, second, message in (
        ([0, 1], [1], "expected two rows"),
        ([0.5], [1], "expected two rows of whole numbers"),
        ([0], [40], "expected scans from 0 to 39, got 40 to 40"),
        ([-1], [1], "expected scans from 0 to 39, got -1"),
    ):
        with pytest.raises(ValueError, match=f"relation_covs: first, second: {message}"):
            laser_slam.relation_covs(solved, first, second)
    assert laser_slam.relation_covs(solved, [0, 3], [0, 3]).max() == 0
    assert laser_slam.relation_covs(solved, np.zeros(0, int), np.zeros(0, int)).shape == (0, 3, 3)
