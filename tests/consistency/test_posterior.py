"""Posteriors of constants by the likelihood that a filter computes; `docs/tutorials/posterior.md`."""

from functools import partial

import broken
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm

from jaxslam import Scenario, filters, motion, run, sensors, simulate

STEPS, DRAWS = 16, 120
PRIOR, SPREAD = np.array([np.log(np.deg2rad(1.0)), 0.0]), np.array([0.5, 0.1])
POSTS = np.array([[3.0, 1.0], [-2.0, 2.0]])
CONTROLS = np.tile([0.3, 0.3], (STEPS, 1))


def models(q):
    """Of q = (log σ of the bearing, rotation of the mount)."""
    sigma = jnp.stack([0.05 + 0.0 * q[0], jnp.exp(q[0])])
    mount = jnp.stack([0.3 + 0.0 * q[1], 0.0 * q[1], q[1]])
    moved = motion.Increment(np.diag([0.02, 0.01]) ** 2)
    return moved, sensors.RangeBearing(jnp.diag(sigma**2), mount=mount)


def draw(key):
    first, second = jax.random.split(key)
    q = PRIOR + SPREAD * jax.random.normal(first, (2,))
    world = Scenario("curve", *models(q), landmarks=POSTS, controls=CONTROLS)
    return q, simulate(world, second)[1]


def log_density(q, log):
    ekf = filters.EkfSlam(*models(q), 2, correction="joint")
    info = run(ekf, log, np.zeros(3), np.zeros((3, 3)), jax.random.key(0)).info
    return info.log_likelihood.sum() - (((q - PRIOR) / SPREAD) ** 2).sum() / 2


@pytest.fixture(scope="module")
def drawn():
    """Constants, and the posterior of each log on a grid about them, (DRAWS, 25, 25) as shares."""
    keys = jax.random.split(jax.random.key(3), DRAWS)
    true, logs = jax.device_get(jax.jit(jax.vmap(draw))(keys))
    half = np.stack(
        [np.full(DRAWS, 1.2), 0.03 + 3 * np.exp(true[:, 0])], 1
    )  # wide enough: see below
    offsets = np.linspace(-1, 1, 25)
    unit = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 2)
    grid = true[:, None] + unit * half[:, None]
    value = jax.jit(jax.vmap(jax.vmap(log_density, (0, None))))(grid, logs)
    share = np.exp(value - np.max(value, axis=1, keepdims=True))
    share = (share / share.sum(axis=1, keepdims=True)).reshape(DRAWS, 25, 25)
    return true, logs, half, share


def marginals(share):
    return share.sum(axis=2), share.sum(axis=1)


def test_the_truth_has_a_uniform_rank_in_its_posterior(drawn):
    """By quadrature, without a sampler; a posterior of two thirds of the width is found out."""
    true, _, half, share = drawn
    for each in marginals(share):
        assert each[:, [0, -1]].max() < 0.01
        rank = each[:, :12].sum(axis=1) + each[:, 12] / 2  # the truth is in the middle of its cell
        total = (norm.ppf(rank) ** 2).sum()
        assert kstest(rank, "uniform").pvalue > 1e-3
        assert 1e-3 < chi2.sf(total, DRAWS) < 1 - 1e-3
        assert chi2.sf(2.25 * total, DRAWS) < 1e-3


@pytest.mark.sweep
def test_nuts_samples_the_same_posterior(drawn):
    """Mean and deviation of one log's, by an independent sampler, beside those of the grid."""
    blackjax = broken.optional("blackjax")
    true, logs, half, share = drawn
    i, offsets = 0, np.linspace(-1, 1, 25)
    log = jax.tree.map(lambda leaf: leaf[i], logs)
    by_grid = []
    for k, each in enumerate(marginals(share)):
        at = true[i, k] + half[i, k] * offsets
        mean = each[i] @ at
        by_grid.append((mean, np.sqrt(each[i] @ (at - mean) ** 2)))
    mean, deviation = np.array(by_grid).T

    @jax.jit
    def sample(start, log, keys):
        nuts = blackjax.nuts(partial(log_density, log=log), 0.8, jnp.asarray(deviation**2))

        def step(state, key):
            state, _ = nuts.step(key, state)
            return state, state.position

        return jax.lax.scan(step, nuts.init(start), keys)[1]

    found = np.asarray(sample(mean, log, jax.random.split(jax.random.key(4), 400)))[20:]
    assert np.all(np.abs(found.mean(axis=0) - mean) < 0.25 * deviation)  # 4 σ of 250 samples
    assert np.all(np.abs(found.std(axis=0) / deviation - 1) < 0.2)
