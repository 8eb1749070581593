"""Resampling: every method is unbiased, keeps to its own bound, and survives weights that do not."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.resampling import REGISTRY
from jaxslam.resampling.weights import at_points, effective_size, normalized, weights_of

WEIGHTS = np.array([0.02, 0.0, 0.35, 0.1, 0.03, 0.25, 0.05, 0.2])


NORMALIZED = jax.jit(normalized)


@cache
def many(method):
    """The method, for one row of weights and many keys."""
    return jax.jit(jax.vmap(method, (None, 0)))


@cache
def keys_of(runs):
    return jax.random.split(jax.random.key(0), runs)


def copies(method, log_weights, runs):
    """How often each particle was chosen, (runs, P)."""
    chosen = many(method)(np.asarray(log_weights), keys_of(runs))
    count = len(log_weights)
    assert chosen.shape == (runs, count)
    assert chosen.dtype == jnp.int32
    return (np.asarray(chosen)[:, :, None] == np.arange(count)).sum(axis=1)


@pytest.fixture(params=sorted(REGISTRY))
def named(request):
    return request.param, REGISTRY[request.param]


def test_the_number_of_copies_is_the_weight_on_average_and_keeps_its_bound(named):
    """Against P w_j, within 5 standard errors of the multinomial, which has the most variance."""
    name, method = named
    with np.errstate(divide="ignore"):
        found = copies(method, np.log(WEIGHTS) + 700.0, runs=4000)  # of any scale
    share = len(WEIGHTS) * WEIGHTS
    error = np.sqrt(share * (1 - WEIGHTS) / 4000)
    assert np.all(np.abs(found.mean(axis=0) - share) <= 5 * error)
    assert np.all(found[:, 1] == 0)
    near = 1e-9  # of a whole number, which the scale may move by a rounding error
    if name == "systematic":
        assert np.all(found >= np.floor(share - near))
        assert np.all(found <= np.ceil(share + near))
    elif name == "residual":
        assert np.all(found >= np.floor(share - near))
    elif name == "stratified":
        assert np.all(np.abs(found - share) < 2)
    else:  # the variance of the plain bootstrap, within a fifth
        np.testing.assert_allclose(found.var(axis=0), share * (1 - WEIGHTS), rtol=0.2)


def test_one_particle_goes_on(named):
    chosen = jax.jit(named[1])
    for log_weight in (0.0, -1e300, -np.inf, np.nan):
        assert np.asarray(chosen(np.array([log_weight]), jax.random.key(0))) == [0]


def test_where_all_underflow_all_weigh_the_same_and_what_is_not_finite_is_not_chosen(named):
    """And all of the weight may be on one."""
    name, method = named
    rows = np.array(
        [
            [-np.inf] * 5,
            [np.nan] * 5,
            [-np.inf, 0.0, np.nan, np.inf, 0.0],
            [-1e5, 0.0, -1e5, -1e5, -np.inf],
        ]
    )
    over = jax.jit(jax.vmap(jax.vmap(method, (None, 0)), (0, None)))
    chosen = np.asarray(over(rows, keys_of(2000)))
    assert chosen.shape == (4, 2000, 5)
    assert chosen.dtype == np.int32
    found = (chosen[..., None] == np.arange(5)).sum(axis=2)
    np.testing.assert_allclose(found[:2].mean(axis=1), 1.0, atol=0.12)
    if name in ("systematic", "residual", "stratified"):
        assert np.all(found[:2] == 1)
    assert np.all(found[2][:, [0, 2, 3]] == 0)
    assert np.all(found[3] == [0, 5, 0, 0, 0])


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_both_precisions_many_particles(named, dtype):
    _, method = named
    log_weights = np.random.default_rng(0).normal(size=5000).astype(dtype)
    ancestors = np.asarray(jax.jit(method)(log_weights, jax.random.key(1)))
    assert ancestors.dtype == np.int32
    assert np.all((ancestors >= 0) & (ancestors < 5000))
    if dtype == "f8":
        eager = method(jnp.asarray(log_weights), jax.random.key(1))
        np.testing.assert_array_equal(ancestors, eager)


def test_normalized_weights_against_plain_arithmetic():
    log_weights = np.array([-1000.0, -1001.0, -np.inf, -999.5])
    w = np.exp(log_weights + 1000)
    out, total, some = NORMALIZED(log_weights)
    np.testing.assert_allclose(np.exp(out), w / w.sum(), rtol=1e-13)
    np.testing.assert_allclose(total, np.log(w.sum()) - 1000, rtol=1e-14)
    assert some
    np.testing.assert_allclose(
        jax.jit(effective_size)(out), w.sum() ** 2 / (w**2).sum(), rtol=1e-13
    )
    np.testing.assert_allclose(jax.jit(weights_of)(np.full(4, np.nan)), 0.25)


def test_gradients_of_the_weights_are_finite():
    """Also where some or all weigh nothing."""
    slope_of = jax.jit(jax.grad(lambda x: normalized(x)[1] + effective_size(x)))
    for log_weights in ([0.0, -np.inf, -3.0], [-np.inf] * 3, [0.0, np.nan, -1e308]):
        slope = slope_of(np.array(log_weights))
        assert np.all(np.isfinite(slope))


def test_points_rounded_to_one_choose_the_last_that_weighs():
    weights = np.array([0.5, 0.5, 0.0])
    chosen = jax.jit(at_points)(weights, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_array_equal(chosen, [0, 1, 1])
