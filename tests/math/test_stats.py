"""stats: chi-square quantiles and bands against SciPy, published tables and sampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from cases import refused

from jaxslam import stats

DOFS = [1, 2, 3, 5, 40]


@pytest.mark.parametrize("dof", DOFS)
def test_quantile_undoes_the_tail_of_scipy(dof):
    for p in (1e-4, 0.025, 0.5, 0.95, 0.9999):
        x = stats.chi2_quantile(p, dof)
        assert isinstance(x, float)
        np.testing.assert_allclose(scipy.stats.chi2.sf(x, dof), 1 - p, rtol=1e-9)


def test_sigma_ellipses_hold_what_solas_table_says():
    """Solà B.3.1 Table 3, with the digits of the errata, per cent."""
    for dof, table in ((2, [39.35, 86.47, 98.89, 99.97]), (3, [19.87, 73.85, 97.07, 99.89])):
        held = [100 * stats.sigma_gate(n, dof) for n in (1, 2, 3, 4)]
        np.testing.assert_allclose(held, table, atol=0.005)
        for n in (0.5, 3, 5):
            np.testing.assert_allclose(stats.chi2_quantile(stats.sigma_gate(n, dof), dof), n**2)


@pytest.mark.parametrize("dof", [1, 2, 3, 4, 7, 12])
def test_quantile_of_an_array_is_scipys(dof):
    """Of the gate of a filter within a trace: in both precisions, batched, and its derivative."""
    p = np.array([0.001, 0.01, 0.3, 0.5, 0.9, 0.99, 0.999, 0.9999, 0.999999])
    for dtype, rtol in ((np.float64, 1e-9), (np.float32, 4e-5)):
        rounded = p.astype(dtype)
        x = stats.chi2_quantile(jnp.asarray(rounded), dof)
        slope = jax.vmap(jax.grad(lambda p: stats.chi2_quantile(p, dof)))(jnp.asarray(rounded))
        assert x.dtype == slope.dtype == dtype
        expected = scipy.stats.chi2.isf(1 - rounded.astype(float), dof)
        np.testing.assert_allclose(x, expected, rtol=rtol)
        np.testing.assert_allclose(slope, 1 / scipy.stats.chi2.pdf(expected, dof), rtol=10 * rtol)


@pytest.mark.parametrize("dof", [1, 2, 3, 4])
def test_quantile_of_an_array_at_its_limits(dof):
    """1 is the number below it, a number outside 0 to 1 counts as 0; no slope there, and no NaN."""
    p = jnp.asarray([0.0, -1.0, 9.0, jnp.nan, 1.0])
    values, slopes = jax.vmap(jax.value_and_grad(lambda p: stats.chi2_quantile(p, dof)))(p)
    np.testing.assert_array_equal(values[:4], 0)
    np.testing.assert_allclose(values[4], scipy.stats.chi2.isf(2.0**-53, dof), rtol=1e-12)
    np.testing.assert_array_equal(slopes, 0)


@pytest.mark.parametrize(("dof", "runs", "level"), [(3, 50, 0.95), (2, 1, 0.99), (5, 2000, 0.5)])
def test_band_is_scipys_and_holds_the_mean(dof, runs, level):
    low, high = stats.chi2_band(dof, runs, level)
    expected = scipy.stats.chi2.interval(level, dof * runs)
    np.testing.assert_allclose([low, high], np.array(expected) / runs, rtol=1e-12)


def test_band_holds_its_share_of_sample_means():
    """Binomial check: 4000 means of 20 χ²_3, 95 % band; 4.5 standard errors of the share, 1.6 %."""
    means = np.random.default_rng(0).chisquare(3, size=(4000, 20)).mean(axis=1)
    low, high = stats.chi2_band(3, 20)
    share = np.mean((means > low) & (means < high))
    assert abs(share - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / 4000)


def test_bar_shalom_band_of_fifty_runs():
    """Bar-Shalom, Li, Kirubarajan 2001: χ²_100 lies in [74.2, 129.6] with 95 %: NEES of 2 states."""
    np.testing.assert_allclose(stats.chi2_band(2, 50), [1.484, 2.591], atol=1e-3)


def test_t_quantile():
    """Table values of Student's t; with many degrees of freedom, the normal's."""
    table = [(0.975, 1, 12.706), (0.975, 10, 2.228), (0.95, 5, 2.015), (0.975, 10**7, 1.95996)]
    for p, dof, value in table:
        np.testing.assert_allclose(stats.t_quantile(p, dof), value, atol=5e-4)


@refused(
    (lambda: stats.chi2_quantile(0.0, 2), "probability"),
    (lambda: stats.chi2_quantile(1.0, 2), "probability"),
    (lambda: stats.chi2_quantile(float("nan"), 2), "probability"),
    (lambda: stats.chi2_quantile(0.5, 0), "dof above 0"),
    (lambda: stats.chi2_quantile(0.5, float("nan")), "dof above 0"),
    (lambda: stats.sigma_gate(0, 2), "n_sigma above 0"),
    (lambda: stats.sigma_gate(-3, 2), "n_sigma above 0"),
    (lambda: stats.sigma_gate(3, 0), "dof above 0"),
    (lambda: stats.chi2_band(2, 0), "run"),
    (lambda: stats.chi2_band(2, 10, 1.0), "probability"),
    (lambda: stats.chi2_band(2, 10, 1.5), "probability"),
    (lambda: stats.chi2_band(-2, 10), "dof above 0"),
)
def test_arguments_out_of_range_are_refused(call):
    call()
