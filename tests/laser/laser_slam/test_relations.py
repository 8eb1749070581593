"""Covariances of relative poses by the graph, against dense NumPy, and relations of the true path."""

import dataclasses

import numpy as np
import pytest
from ring_of_rooms import SETTINGS, driven

from jaxslam import laser_slam, metrics
from jaxslam.laser.laser_slam import covariances
from jaxslam.laser.laser_slam import score as module
from jaxslam.math import numpy_poses as poses


@pytest.fixture(scope="module")
def drive():
    """(true path, result): every second scan is a keyframe."""
    true, log = driven()
    found = laser_slam.solve(log, dataclasses.replace(SETTINGS, key_distance=1.5, loop_gap=8))
    assert found.counts["loops kept"] >= 3
    return true, found


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


def dense(found, i, j):
    """The covariance of the end of x_i⁻¹ ∘ x_j: that of all keyframes and all scans on them,
    through one function of all."""
    graph = found.graph
    at = np.asarray(graph.poses)
    free = at[1:].ravel()
    jacobian = derivatives(lambda v: residuals(v, graph), free)
    cov = np.zeros((len(free) + 6, len(free) + 6))
    cov[:-6, :-6] = np.linalg.inv(jacobian.T @ jacobian)
    cov[-6:-3, -6:-3], cov[-3:, -3:] = found.z_cov[i], found.z_cov[j]
    estimate = poses.between(found.poses[i], found.poses[j])

    def end(v):
        keys = np.concatenate([at[:1], v[:-6].reshape(-1, 3)])
        ends = poses.compose(found.z[[i, j]], v[-6:].reshape(2, 3))
        x = poses.compose(keys[found.base[[i, j]]], ends)
        return poses.between(estimate, poses.between(x[0], x[1]))

    by = derivatives(end, np.concatenate([free, np.zeros(6)]))
    return by @ cov @ by.T


def test_the_covariances_are_those_of_the_dense_inverse(drive, monkeypatch):
    _, found = drive
    count = len(found.poses)
    between = np.setdiff1d(np.arange(count), found.keyframe)
    assert len(found.keyframe) > 8 and len(between) > 8 and found.base[3] == 1
    scans = np.arange(1, count)
    of_path = covariances.of_coordinates(
        laser_slam.relation_covs(found, 0 * scans, scans), found.poses[1:]
    )
    np.testing.assert_allclose(of_path, found.cov[1:], rtol=1e-6, atol=1e-12)
    # Scan 5 beside 3 on the keyframe 2.
    base, z, z_cov, path = (np.array(x) for x in (found.base, found.z, found.z_cov, found.poses))
    base[5], z[5] = 1, [0.3, -0.2, 1.0]
    path[5] = poses.compose(path[2], z[5])
    found = found._replace(base=base, z=z, z_cov=z_cov, poses=path)
    ends = [0, *found.keyframe[[3, -1]], 1, 3, 5, 39]
    pairs = np.array([(i, j) for i in ends for j in ends if i != j])
    monkeypatch.setattr(module, "TOGETHER", 7)
    covs = laser_slam.relation_covs(found, *pairs.T)
    for (i, j), cov in zip(pairs, covs, strict=True):
        np.testing.assert_allclose(cov, dense(found, i, j), rtol=1e-6, atol=1e-6 * cov.max())


def test_the_error_of_a_relation_by_its_covariance(drive):
    true, found = drive
    made = metrics.joined(*(metrics.relations(true, rows=rows) for rows in (1, 3, 7, 24)))
    nees = laser_slam.relation_nees(found, *made)
    assert (nees < 7.81).mean() > 0.9 and 0.3 < nees.mean() < 6
    k = 40
    cov = laser_slam.relation_covs(found, made.first[k : k + 1], made.second[k : k + 1])[0]
    estimate = poses.between(found.poses[made.first[k]], found.poses[made.second[k]])
    e = 2 * np.linalg.cholesky(cov)[:, 1]
    off = made._replace(pose=poses.compose(estimate, e)[None].repeat(len(nees), 0))
    assert laser_slam.relation_nees(found, *off)[k] == pytest.approx(4)
    same = metrics.Relations(made.first[:2], made.first[:2], np.zeros((2, 3)))
    assert np.isnan(laser_slam.relation_nees(found, *same)).all()


def test_scans_that_are_none_are_refused(drive):
    _, found = drive
    for first, second, message in (
        ([0, 1], [1], "expected two rows"),
        ([0.5], [1], "expected two rows of whole numbers"),
        ([0], [40], "expected scans from 0 to 39, got 40 to 40"),
        ([-1], [1], "expected scans from 0 to 39, got -1"),
    ):
        with pytest.raises(ValueError, match=f"relation_covs: {message}"):
            laser_slam.relation_covs(found, first, second)
    assert laser_slam.relation_covs(found, [0, 3], [0, 3]).max() == 0
    assert laser_slam.relation_covs(found, np.zeros(0, int), np.zeros(0, int)).shape == (0, 3, 3)
