"""The unscented transform against its textbook sums; `test_catalog` has the filters that use it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import linearize
from jaxslam.linearize._unscented import by_variables, regress


def curved(xi):
    return jnp.stack([xi[0] ** 2 + xi[1], jnp.sin(xi[1]) * jnp.exp(xi[0]) - 0.3 * xi[0] * xi[2]])


def textbook(f, cov, alpha):
    """Mean, cross-covariance and covariance by the weighted sums as they are published."""
    n = len(cov)
    root = np.linalg.cholesky(cov) * alpha * np.sqrt(n)
    points = np.concatenate([np.zeros((1, n)), root.T, -root.T])
    values = np.array([np.asarray(f(p)) for p in points])
    w = np.full(2 * n + 1, 1 / (2 * alpha**2 * n))
    w_mean, w_cov = w.copy(), w.copy()
    w_mean[0] = 1 - 1 / alpha**2
    w_cov[0] = w_mean[0] + 3 - alpha**2
    mean = w_mean @ values
    off = values - mean
    return mean, points.T @ (w_cov[:, None] * off), off.T @ (w_cov[:, None] * off)


@pytest.mark.parametrize("alpha", [1.0, 0.3])
def test_the_regression_is_the_unscented_transform(alpha):
    draw = np.random.default_rng(0).normal(size=(3, 3))
    cov = draw @ draw.T * 0.1
    root = np.linalg.cholesky(cov)
    out = jax.jit(lambda root: regress(curved, root, alpha))(root)
    mean, cross, spread = textbook(jax.jit(curved), cov, alpha)
    np.testing.assert_allclose(out.mean, mean, atol=1e-12)
    np.testing.assert_allclose(out.slope @ root.T, cross.T, atol=1e-12)
    np.testing.assert_allclose(out.slope @ out.slope.T + out.rest, spread, atol=1e-11)
    slope = np.asarray(jax.jit(by_variables)(out.slope, root))
    np.testing.assert_allclose(slope @ cov, cross.T, atol=1e-12)


def test_of_an_affine_function_nothing_is_left_over():
    a = np.random.default_rng(1).normal(size=(2, 4))
    root = np.tril(np.random.default_rng(2).normal(size=(4, 4)))
    root = root * np.sign(np.diagonal(root))
    out = jax.jit(lambda root: regress(lambda xi: a @ xi, root, 0.5))(root)
    np.testing.assert_allclose(by_variables(out.slope, jnp.asarray(root)), a, atol=1e-12)
    np.testing.assert_allclose(out.mean, 0, atol=1e-15)
    np.testing.assert_allclose(out.rest, 0, atol=1e-15)


@pytest.mark.parametrize("alpha", [0.0, 1.5, -1e-3])
def test_a_spread_out_of_range_is_refused(alpha):
    with pytest.raises(ValueError, match="alpha"):
        linearize.Unscented(alpha)
