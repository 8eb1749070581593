"""Resampling: unbiased, within bounds, with bad weights; gradients through it; the KLD bound."""

import math
from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from cases import swept

from jaxslam.resampling import REGISTRY, Soft, StopGradient, _kld, _weights, kld_bound, systematic

WEIGHTS = np.array([0.02, 0.0, 0.35, 0.1, 0.03, 0.25, 0.05, 0.2])


NORMALIZED = jax.jit(_weights.normalize)


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


@pytest.mark.parametrize("dtype", swept(["f4", "f8"], "f8"))
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
        jax.jit(_weights.effective_size)(out), w.sum() ** 2 / (w**2).sum(), rtol=1e-13
    )
    np.testing.assert_allclose(jax.jit(_weights.weights_of)(np.full(4, np.nan)), 0.25)


def test_gradients_of_the_weights_are_finite():
    """Also where some or all weigh nothing."""
    slope_of = jax.jit(jax.grad(lambda x: _weights.normalize(x)[1] + _weights.effective_size(x)))
    for log_weights in ([0.0, -np.inf, -3.0], [-np.inf] * 3, [0.0, np.nan, -1e308]):
        slope = slope_of(np.array(log_weights))
        assert np.all(np.isfinite(slope))


def test_points_rounded_to_one_choose_the_last_that_weighs():
    weights = np.array([0.5, 0.5, 0.0])
    chosen = jax.jit(_weights.at_points)(weights, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_array_equal(chosen, [0, 1, 1])


# --- Gradients through resampling, against the Kalman filter's exact score; and the KLD bound -----


# x' = a x + q ε, z = x + r η; x_0 ~ N(0, 1) before the first step
A, Q, R = 0.7, 0.5, 0.4
Z = np.array([0.5, 0.9, 1.2, 0.7, 1.1, 1.6, 1.3, 0.9])  # as of a larger a: the score is not zero


def exact(a):
    """log p(z | a) by a scalar Kalman filter, plain arithmetic."""
    mean, var, out = 0.0, 1.0, 0.0
    for z in Z:
        mean, var = a * mean, a * a * var + Q**2
        total = var + R**2
        out += -0.5 * ((z - mean) ** 2 / total + math.log(2 * math.pi * total))
        gain = var / total
        mean, var = mean + gain * (z - mean), (1 - gain) * var
    return out


def estimated(a, key, method, count):
    """log of the bootstrap particle filter's estimate of p(z | a), draws reparameterized."""
    key, begin = jax.random.split(key)
    x = jax.random.normal(begin, (count,))
    log_w = jnp.full(count, -math.log(count))

    def step(carry, row):
        x, log_w = carry
        z, key = row
        key_noise, key_resample = jax.random.split(key)
        x = a * x + Q * jax.random.normal(key_noise, x.shape)
        fit = -0.5 * ((z - x) / R) ** 2 - math.log(R * math.sqrt(2 * math.pi))
        weight, total, _ = _weights.normalize(log_w + fit)
        ancestor, log_w = _weights.survivors(method, weight, key_resample)
        return (x[ancestor], log_w), total

    rows = jnp.asarray(Z), jax.random.split(key, len(Z))
    return jax.lax.scan(step, (x, log_w), rows)[1].sum()


METHODS = {
    "plain": systematic,
    "stop_gradient": StopGradient(),
    "soft": Soft(0.5),
    "soft, all of w": Soft(1.0),
}


@pytest.fixture(scope="module")
def slopes():
    """By method: mean over seeds of value and gradient, and their standard errors."""
    keys, seeds = jax.random.split(jax.random.key(11), 200), math.sqrt(200)

    def all_of(a, key):
        each = {n: partial(estimated, method=m, count=150) for n, m in METHODS.items()}
        return {n: jax.jvp(partial(f, key=key), (a,), (1.0,)) for n, f in each.items()}

    found = jax.device_get(jax.jit(jax.vmap(all_of, (None, 0)))(A, keys))
    return {n: [(x.mean(), x.std() / seeds) for x in both] for n, both in found.items()}


def score():
    return (exact(A + 1e-5) - exact(A - 1e-5)) / 2e-5


def test_the_stop_gradient_estimator_finds_the_score_and_plain_resampling_does_not(slopes):
    value, slope = slopes["stop_gradient"]
    plain_value, plain = slopes["plain"]
    np.testing.assert_allclose(value, plain_value, rtol=1e-12)  # the forward pass is the same
    np.testing.assert_allclose(value[0], exact(A), atol=0.06)
    # The bias of the logarithm of an unbiased estimate is of order 1/P.
    assert abs(slope[0] - score()) < 4 * slope[1] + 0.05 * abs(score())
    assert abs(plain[0] - score()) > 0.5 * abs(score())
    assert abs(plain[0] - score()) > 10 * plain[1]


def test_soft_resampling_lies_between_and_is_biased(slopes):
    """Nearer to the score than without a gradient, and off it by many standard errors."""
    plain, half, whole = (slopes[n][1] for n in ("plain", "soft", "soft, all of w"))
    np.testing.assert_allclose(whole[0], plain[0], rtol=1e-9)
    assert abs(half[0] - score()) < abs(plain[0] - score())
    assert abs(half[0] - score()) > 10 * half[1]


def test_the_weights_of_soft_copies_are_the_ratio_to_what_they_were_drawn_from():
    w = np.array([0.5, 0.3, 0.2, 0.0])
    with np.errstate(divide="ignore"):
        log_w = np.log(w) + 50
    ancestor, after = jax.jit(Soft(0.6))(log_w, jax.random.key(3))
    q = 0.6 * w + 0.4 / 4
    share = (w / q)[np.asarray(ancestor)]
    np.testing.assert_allclose(np.exp(after), share / share.sum(), rtol=1e-12)
    # over many draws, the weighted counts are the weights
    keys = jax.random.split(jax.random.key(4), 4000)
    ancestor, _ = jax.jit(jax.vmap(Soft(0.6), (None, 0)))(log_w, keys)
    found = [(np.asarray(ancestor) == j).mean() * (w / q)[j] for j in range(4)]
    np.testing.assert_allclose(found, w, atol=0.01)


@pytest.mark.parametrize("method", [Soft(0.5), StopGradient()], ids=["soft", "stop_gradient"])
@pytest.mark.parametrize(
    "log_w", [[[0.0, -1.0, -np.inf], [-np.inf] * 3, [np.nan, 0.0, -1e308]], [[3.0]]]
)
def test_gradients_stay_finite_and_the_sum_is_one(method, log_w):
    def cost(x):
        ancestor, after = method(x, jax.random.key(0))
        return (jnp.exp(after) * (1.0 + ancestor)).sum(), after

    both = jax.jit(jax.vmap(jax.value_and_grad(cost, has_aux=True)))
    (value, after), slope = both(np.array(log_w))
    chex.assert_tree_all_finite((value, slope))
    np.testing.assert_allclose(np.exp(after).sum(axis=1), 1.0, rtol=1e-12)


def test_bad_shares_are_refused():
    for share in (-0.1, 1.1, np.nan):
        with pytest.raises(ValueError, match="share: expected a number from 0 to 1"):
            Soft(share)


# --- KLD sampling -------------------------------------------------------------------------------

BOUND = jax.jit(kld_bound, static_argnums=2)


def test_the_bound_against_plain_arithmetic_and_against_chi_square():
    z = scipy.stats.norm.ppf(0.99)
    for k in (2, 10, 100, 1000):
        d = k - 1
        wanted = d / (2 * 0.05) * (1 - 2 / (9 * d) + math.sqrt(2 / (9 * d)) * z) ** 3
        np.testing.assert_allclose(BOUND(np.asarray(k), 0.05, 0.99), wanted, rtol=1e-12)
        # what it approximates: the quantile of chi square over 2 ε
        np.testing.assert_allclose(wanted, scipy.stats.chi2.ppf(0.99, d) / 0.1, rtol=0.02)
    np.testing.assert_array_equal(BOUND(np.array([0, 1]), 0.05, 0.99), 0.0)


def test_the_bound_keeps_its_promise():
    """Of n draws of a uniform distribution over k bins the divergence is below ε, 99 in 100."""
    rng, k, error = np.random.default_rng(0), 30, 0.05
    n = math.ceil(float(BOUND(np.asarray(k), error, 0.99)))
    share = rng.multinomial(n, np.full(k, 1 / k), size=4000) / n
    divergence = (share * np.log(np.where(share > 0, share * k, 1.0))).sum(axis=1)
    assert abs((divergence < error).mean() - 0.99) < 0.006


def test_enough_is_foxs_loop():
    """Against one particle after another and a set of bins."""
    rng = np.random.default_rng(2)
    pose = np.column_stack([rng.normal(size=(600, 2)), rng.uniform(-np.pi, np.pi, 600)])
    size = (0.5, 0.7, math.radians(25))
    enough = jax.jit(lambda moved, *of: _kld.enough(_kld.bins_of(moved, size), *of, 0.99))
    for spread, least, error in ((1.0, 20, 0.5), (0.2, 20, 0.1), (0.01, 33, 0.05), (3.0, 5, 0.05)):
        moved = pose * [spread, spread, 1.0]
        bound = np.asarray(BOUND(np.arange(601), error, 0.99))
        seen, wanted, few = set(), len(pose), True
        for m, (x, y, heading) in enumerate(moved, start=1):
            seen.add((x // size[0], y // size[1], (heading + math.pi) // size[2]))
            if m >= least and m >= bound[len(seen)]:
                wanted, few = m, False
                break
        count, short = enough(moved, least, error)
        assert (int(count), bool(short)) == (wanted, few)


def test_headings_on_both_sides_of_the_seam_and_poses_far_away_have_bins():
    size = (1.0, 1.0, 2 * math.pi / 6)
    pose = np.array([[0, 0, np.pi], [0, 0, -np.pi], [1e300, -1e300, 0.0], [-0.5, 0.5, 0.0]])
    bins = np.asarray(jax.jit(partial(_kld.bins_of, size=size))(pose))
    occupied = jax.jit(_kld.count_distinct)
    np.testing.assert_array_equal(bins[:2], [[0, 0, 5], [0, 0, 0]])
    np.testing.assert_array_equal(bins[3], [-1, 0, 3])
    np.testing.assert_array_equal(occupied(bins), [1, 2, 3, 4])
    np.testing.assert_array_equal(occupied(bins[[0, 0, 1, 0, 1]]), [1, 1, 2, 2, 2])
