"""`calibration.fit_noise`: closed forms of toy likelihoods, and a filter's noises from simulated logs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused

import jaxslam
from jaxslam import association, filters, motion, sensors
from jaxslam.calibration import as_associated, fit_noise
from jaxslam.core.types import Info, Status
from jaxslam.math import stats

pytestmark = pytest.mark.decision

RNG = np.random.default_rng(2)
X = RNG.normal(0.3, 2.0, 400)


def of(innovation, variance, fused=True):
    """The info of scans of one scalar measurement each."""
    nu, s = innovation[:, None, None], variance[:, None]
    nis = nu[..., 0] ** 2 / s
    fused = jnp.broadcast_to(fused, nis.shape)
    each = -0.5 * (nis + jnp.log(2 * jnp.pi * s))
    status = jnp.where(fused, Status.FUSED, Status.REJECTED)
    total = jnp.where(fused, each, 0.0).sum(axis=1)
    return Info(nis, fused.astype(int), nu, s[..., None, None], 0 * status, status, total)


def scatter(p, x):
    return of(x - p[1], jnp.full(x.shape, p[0] ** 2))


def test_mean_and_deviation_of_a_sample_with_their_errors():
    """σ̂² is the mean square about the mean; by log σ the information is 2n, by the mean n/σ²."""
    fit = fit_noise(
        scatter, [0.5, 0.0], X, names=("sigma", "mean"), deviation=(True, False), tolerance=1e-6
    )
    n, sigma = len(X), X.std()
    np.testing.assert_allclose(fit.parameters, [sigma, X.mean()], rtol=1e-4)
    np.testing.assert_allclose(fit.error, sigma / np.sqrt([2 * n, n]), rtol=2e-3)
    np.testing.assert_allclose(fit.nis_per_dof[1], 1, rtol=1e-4)
    np.testing.assert_allclose(fit.nis_per_dof[0], np.mean(X**2) / 0.25)
    best = -0.5 * n * (1 + np.log(2 * np.pi * sigma**2))
    np.testing.assert_allclose(fit.log_likelihood[1], best, rtol=1e-6)
    z = (X - X.mean()) / sigma
    slopes = np.stack([z**2 - 1, z / sigma])  # by log σ and by the mean
    bread = np.diag([1 / (2 * n), sigma**2 / n])
    robust = np.sqrt(np.diag(bread @ slopes @ slopes.T @ bread)) * [sigma, 1]
    np.testing.assert_allclose(fit.robust_error, robust, rtol=5e-3)
    assert fit.converged and not fit.loose and not fit.upper
    assert (fit.dof, fit.names) == (n, ("sigma", "mean"))


def test_a_search_from_elsewhere_ends_there_and_is_compared_with_the_start():
    options = {"deviation": (True, False), "tolerance": 1e-6}
    fit = fit_noise(scatter, [0.5, 0.0], X, guess=[5.0, -1.0], **options)
    np.testing.assert_allclose(fit.path[0], [5, -1])
    np.testing.assert_allclose(fit.nis_per_dof[0], np.mean(X**2) / 0.25)
    np.testing.assert_allclose(fit.parameters, [X.std(), X.mean()], rtol=1e-4)


def fenced(p, x):
    """Not finite a little beyond the maximum."""
    return of(x, jnp.where(p[0] < 1.05 * X.std(), p[0], jnp.nan) ** 2 + 0 * x)


def test_a_step_to_where_the_likelihood_is_not_finite_is_taken_back():
    fit = fit_noise(fenced, [0.1], X - X.mean(), tolerance=1e-6)
    np.testing.assert_allclose(fit.parameters, X.std(), rtol=1e-4)
    assert fit.converged


def added(p, x):
    """A part of the variance is known, and too large for these innovations."""
    return of(x, 5.0 + p[0] ** 2 + 0 * x)


def test_a_noise_that_goes_to_zero_has_an_upper_limit():
    x = X - X.mean()
    fit = fit_noise(added, [1.0], x, names=["more"])
    assert fit.converged and fit.parameters[0] < 0.1
    (limit,) = fit.upper.values()
    assert not fit.loose

    def value(variance):
        return -0.5 * np.sum(x**2 / variance + np.log(2 * np.pi * variance))

    np.testing.assert_allclose(value(5 + limit**2), value(5.0) - 1.35, atol=0.1)


def confounded(p, x):
    return of(x - p[2], p[0] ** 2 + p[1] ** 2 + 0 * x)


def summed(p, x):
    """The mean is the sum of two parameters, up to a millionth."""
    return of(x - p[1] - p[2] * (1 + 1e-6 * jnp.cos(x)), jnp.full(x.shape, p[0] ** 2))


def test_parameters_of_which_only_a_sum_is_seen_are_named_together():
    fit = fit_noise(summed, [1.0, 0.1, 0.2], X, names=("s", "b", "c"), deviation=[1, 0, 0])
    assert fit.loose == {"b": ("c",), "c": ("b",)}
    np.testing.assert_allclose(fit.parameters[1:].sum(), X.mean(), atol=1e-3)


SAMPLES = {
    "as drawn": X,
    "another order": np.random.default_rng(1).permutation(X),
    "a rounding off": X * (1 + 4e-16 * RNG.normal(size=X.size)),
    "in millimetres": 1000 * X,
    "in kilometres": X / 1000,
}


@pytest.mark.parametrize("start", [(0.5, 0.7), (0.01, 1.0), (1.0, 0.3)])
@pytest.mark.parametrize("sample", SAMPLES)
def test_noises_that_are_told_apart_by_nothing_are_named_together(sample, start):
    x = SAMPLES[sample]
    unit = x.std() / X.std()
    start = np.array([*start, 1.0]) * unit
    fit = fit_noise(confounded, start, x, names=("a", "b", "c"), deviation=[1, 1, 0])
    assert fit.converged and not fit.upper
    assert fit.loose == {"a": ("b",), "b": ("a",)}
    assert np.isinf(fit.error[:2]).all()
    np.testing.assert_allclose(fit.error[2], x.std() / np.sqrt(len(x)), rtol=1e-2)
    np.testing.assert_allclose(np.hypot(*fit.parameters[:2]), x.std(), rtol=1e-2)


def told_apart(p, x):
    """The second noise is in every other measurement alone."""
    return of(x - p[2], p[0] ** 2 + p[1] ** 2 * (jnp.arange(x.size) % 2))


@pytest.mark.parametrize("sample", SAMPLES)
def test_noises_that_are_told_apart_have_errors_in_any_unit(sample):
    """By the other rows a² and b² have the information n/4S² each, with S that of the row."""
    draws = np.random.default_rng(5).normal(size=len(X)) * np.where(np.arange(len(X)) % 2, 2.0, 1.0)
    x = draws * SAMPLES[sample].std() / X.std() * (1 + 1e-15 * (sample == "a rounding off"))
    unit = x.std() / draws.std()
    start = np.array([0.3, 3.0, -1.0]) * unit
    fit = fit_noise(told_apart, start, x, names=("a", "b", "c"), deviation=[1, 1, 0])
    assert fit.converged and not fit.loose and not fit.upper
    np.testing.assert_allclose(fit.parameters / unit, [1, np.sqrt(3), 0], atol=0.3)
    a, b = fit.parameters[:2]
    variance = np.array([a**2, a**2 + b**2])
    by_log = np.array([[2 * a**2, 0], [2 * a**2, 2 * b**2]]) / variance[:, None]
    information = len(x) / 4 * by_log.T @ by_log
    error = np.sqrt(np.diag(np.linalg.inv(information))) * [a, b]
    np.testing.assert_allclose(fit.error[:2], error, rtol=0.05)


def in_pairs(p, x):
    """One pair of noises in the first half, another in the second."""
    first = jnp.arange(x.size) < x.size // 2
    return of(x, jnp.where(first, p[0] ** 2 + p[1] ** 2, p[2] ** 2 + p[3] ** 2))


def test_what_is_confounded_within_pairs_is_named_by_pairs():
    fit = fit_noise(in_pairs, [1.0, 0.8, 0.9, 1.1], X)
    assert fit.loose == {"p0": ("p1",), "p1": ("p0",), "p2": ("p3",), "p3": ("p2",)}


def of_a_sum(p, x):
    return of(x - p[1:].sum(), jnp.full(x.shape, p[0] ** 2))


def test_of_many_that_are_seen_as_a_sum_all_are_named():
    fit = fit_noise(of_a_sum, [1.0, *np.arange(12.0)], X, deviation=[1] + [0] * 12)
    assert list(fit.loose) == [f"p{i}" for i in range(1, 13)]
    assert all(len(others) == 11 for others in fit.loose.values())
    np.testing.assert_allclose(fit.error[0], fit.parameters[0] / np.sqrt(2 * len(X)), rtol=1e-2)


def test_the_decisions_hold_in_float32(float32_alone):
    x = X.astype(np.float32)
    options = {"names": ("a", "b", "c"), "deviation": [1, 1, 0]}
    fit = fit_noise(confounded, [0.5, 0.7, 1.0], x, **options)
    assert fit.converged and fit.loose == {"a": ("b",), "b": ("a",)}
    fit = fit_noise(told_apart, [0.5, 0.7, 1.0], x * (1 + np.arange(x.size) % 2), **options)
    assert fit.converged and not fit.loose


def gated(p, x):
    return of(x, p[0] ** 2 + 0 * x, fused=(jnp.abs(x) < 3 * p[0])[:, None])


def nothing(p, x):
    return of(x, p[0] ** 2 + 0 * x, fused=False)


@refused(
    (gated, [0.5], {}, "expected the same measurements at all parameters, got "),
    (nothing, [0.5], {}, "expected fused measurements, got none at parameters"),
    (scatter, [np.nan, 1], {}, r"start: expected shape \(P,\), finite"),
    (scatter, [0.0, 1], {}, r"expected standard deviations above 0"),
    (scatter, [1.0, 1], {"guess": [1.0]}, r"guess: expected shape \(P,\), finite"),
    (scatter, [1.0, 1], {"names": ["a"]}, "expected 2 of each"),
    (scatter, [1.0, 1], {"iterations": 0}, "iterations: expected an integer >= 1"),
    (scatter, [1.0, 1], {"tolerance": 0}, "tolerance: expected a number above 0"),
    (scatter, [1e-200, 1], {}, "the likelihood or its gradient is not finite"),
    told="fit_noise: .*",
)
def test_bad_input_is_named(info, start, options):
    fit_noise(info, start, X, **options)


TRUE = np.array([0.02, 0.01, 0.05, 0.02])
POINTS = np.array([[3.0, 1.0], [-1.0, 4.0], [-3.0, -1.0]])
KEY = jax.random.key(0)


def models(p):
    cov = jnp.diag(jnp.asarray(p) ** 2)
    return motion.Increment(cov[:2, :2]), sensors.RangeBearing(cov[2:, 2:])


def world(steps=100):
    controls = np.tile([0.1, 4 * np.pi / 200], (steps, 1))
    moving, seeing = models(TRUE)
    return jaxslam.Scenario("round", moving, seeing, landmarks=POINTS, controls=controls)


def followed(p, log):
    ekf = filters.EkfSlam(*models(p), capacity=len(POINTS), correction="joint")
    return jaxslam.run(ekf, log, np.zeros(3), np.zeros((3, 3)), KEY).info


@pytest.mark.sweep
def test_the_noises_of_simulated_logs_are_found_and_errors_are_their_spread():
    """From starts a factor 3 off: over 24 logs the z of each noise are standard normal numbers, by
    bands that honest ones leave once in a thousand, and NIS/dof is 1, since P grows with all noises."""
    place, count, z = world(), 24, []
    for seed in range(count):
        _, log = jaxslam.simulate(place, jax.random.key(seed))
        fit = fit_noise(followed, TRUE * [3, 1 / 3, 3, 1 / 3], log)
        assert fit.converged and not fit.loose and not fit.upper
        assert fit.log_likelihood[1] > fit.log_likelihood[0] + 50
        assert abs(fit.nis_per_dof[1] - 1) < 1e-3
        assert (np.abs(np.log(fit.robust_error / fit.error)) < np.log(1.6)).all()
        z.append(np.log(fit.parameters / TRUE) / (fit.error / fit.parameters))
    z = np.array(z)
    low, high = stats.chi2_band(count, 1, 0.999)
    assert ((z**2).sum(axis=0) > low).all() and ((z**2).sum(axis=0) < high).all(), z
    assert (np.abs(z.mean(axis=0)) < 3.3 / np.sqrt(count)).all(), z.mean(axis=0)


@pytest.mark.sweep
def test_decisions_are_held_in_the_log():
    """Unknown tags and a gate, then known tags and none: the same run, and the rest is not valid."""
    place = world(40)
    _, log = jaxslam.simulate(place, jax.random.key(3))
    z = np.array(log.scan.z)
    z[20, 1] += [0.25, 0]
    log = log._replace(scan=log.scan._replace(z=z, tag=np.full_like(log.scan.tag, -1)))
    nearest = association.Nearest(0.999, 0.9999999)
    options = {"capacity": 5, "correction": "joint"}
    start = np.zeros(3), np.zeros((3, 3)), KEY
    by_gate = filters.EkfSlam(*models(TRUE), associate=nearest, **options)
    first = jaxslam.run(by_gate, log, *start)
    held = as_associated(log, first.info)
    assert (~held.scan.valid & log.scan.valid).sum() == 1 and not held.scan.valid[20, 1]
    again = jaxslam.run(filters.EkfSlam(*models(TRUE), **options), held, *start)
    np.testing.assert_allclose(again.estimate.pose, first.estimate.pose, atol=1e-12)
    np.testing.assert_array_equal(
        again.info.slot[held.scan.valid], first.info.slot[held.scan.valid]
    )
