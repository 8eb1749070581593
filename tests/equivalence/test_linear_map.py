"""Convergence of the map in a linear world: theorems of Dissanayake et al. 2001, section IV.

Robot and landmarks are points in the plane: a heading that is known makes relative positions affine.
"""

import jax
import numpy as np
import pytest

from jaxslam import filters, motion, sensors
from jaxslam.core.types import Log, Scan

STEPS, COUNT = 120, 4
START = np.array([[0.09, 0.02, 0.0], [0.02, 0.04, 0.0], [0.0, 0.0, 0.0]])
Q, R = np.array([[0.01, 0.004], [0.004, 0.006]]), np.array([[0.3, 0.1], [0.1, 0.2]])
BLOCKS = ([0, 1], [2], [1, 4, 7], [0, 1, 2, 3], [3, 5, 6], list(range(2 * COUNT)))
VALID = np.random.default_rng(1).uniform(size=(STEPS, COUNT)) < 0.7
VALID[0] = True


@pytest.fixture(scope="module")
def covs():
    """Covariance of robot and map after each scan, (2, T, D, D): without and with motion noise."""
    tag = np.where(VALID, np.arange(COUNT), -1)
    z = np.random.default_rng(2).normal(size=(STEPS, COUNT, 2))
    log = Log(np.zeros((STEPS, 3)), Scan(z, tag, VALID))

    @jax.jit
    @jax.vmap
    def of(noise):
        moves, sees = motion.PoseIncrement(noise), sensors.RelativePosition(R)
        ekf = filters.EkfSlam(moves, sees, COUNT, correction="joint")

        def step(state, row):
            state, _ = ekf.update(ekf.predict(state, row.control, None), row.scan, None)
            return state, state.cov

        return jax.lax.scan(step, ekf.init(np.zeros(3), START), log)[1]

    noise = np.zeros((2, 3, 3))
    noise[1, :2, :2] = Q
    return np.delete(np.asarray(of(noise)), 2, axis=-1)[:, :, [0, 1, *range(3, 3 + 2 * COUNT)]]


def batch(noise):
    """Covariance of the map, from the information of all positions and landmarks at once."""
    size = 2 * (STEPS + 1 + COUNT)
    root, white = (
        np.linalg.inv(np.linalg.cholesky(START[:2, :2])),
        np.linalg.inv(np.linalg.cholesky(R)),
    )
    rows = [np.zeros((2, size))]
    rows[0][:, :2] = root
    for t in range(STEPS):
        row = np.zeros((2, size))
        row[:, 2 * t : 2 * t + 2], row[:, 2 * t + 2 : 2 * t + 4] = -np.eye(2), np.eye(2)
        rows.append(np.linalg.inv(np.linalg.cholesky(noise)) @ row)
        for i in np.flatnonzero(VALID[t]):
            row, at = np.zeros((2, size)), 2 * (STEPS + 1 + i)
            row[:, 2 * t + 2 : 2 * t + 4], row[:, at : at + 2] = -np.eye(2), np.eye(2)
            rows.append(white @ row)
    a = np.concatenate(rows)
    return np.linalg.inv(a.T @ a)[-2 * COUNT :, -2 * COUNT :]


def test_the_determinant_of_a_block_never_grows(covs):
    maps = covs[:, :, 2:, 2:]
    for block in BLOCKS:
        logs = np.linalg.slogdet(maps[np.ix_(range(2), range(STEPS), block, block)])[1]
        assert np.diff(logs, axis=1).max() < 1e-12, block
    # The robot's own grows where it moves, so the test can fail.
    assert np.diff(np.linalg.slogdet(covs[1, :, :2, :2])[1]).max() > 0


def test_landmarks_become_fully_correlated(covs):
    """The difference of two is known better and better: its variance falls as 1/t."""
    maps = covs[:, :, 2:, 2:]
    for i in range(1, COUNT):
        apart = maps[..., :2, :2] + maps[..., 2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
        cross = maps[..., :2, 2 * i : 2 * i + 2]
        apart = np.trace(apart - cross - np.swapaxes(cross, -1, -2), axis1=-2, axis2=-1)
        assert np.all(apart[:, -1] < 3 / STEPS * apart[:, 0])
    sigma = np.sqrt(np.diagonal(maps[:, -1], axis1=-2, axis2=-1))
    correlation = maps[:, -1] / (sigma[:, :, None] * sigma[:, None])
    assert correlation[:, ::2, ::2].min() > 0.9 and correlation[:, 1::2, 1::2].min() > 0.9


def test_the_limit_is_the_uncertainty_of_the_first_position(covs):
    """Exactly where nothing moves the robot at random; with motion noise it is a lower bound."""
    for still, moved, i in ((covs[0], covs[1], i) for i in range(2, 2 + 2 * COUNT, 2)):
        over = [each[:, i : i + 2, i : i + 2] - START[:2, :2] for each in (still, moved)]
        assert np.linalg.eigvalsh(over[0]).min() > 0
        assert (
            np.linalg.eigvalsh(over[0][-1]).max() < 3 / STEPS * np.linalg.eigvalsh(over[0][0]).max()
        )
        assert np.linalg.eigvalsh(over[1][-1] - Q).min() > 0


def test_it_is_the_marginal_of_the_full_posterior(covs):
    """Online SLAM is full SLAM without the earlier positions: integrated out, all at once."""
    np.testing.assert_allclose(covs[1, -1, 2:, 2:], batch(Q), atol=1e-9)
