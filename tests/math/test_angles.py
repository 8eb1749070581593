"""angles: wrap, sinc and its slope against exact identities, NumPy and differences."""

import math
from fractions import Fraction

import jax
import numpy as np
import pytest

from jaxslam.math.angles import sin_cos, sinc, sinc_slope, wrap

DTYPES = [np.float32, np.float64]


def around_the_seams(dtype):
    """Odd and even multiples of π, each with its two neighbours among the floats."""
    at = np.arange(-51, 52).astype(dtype) * dtype(np.pi)
    return np.concatenate([at, np.nextafter(at, dtype(1e9)), np.nextafter(at, dtype(-1e9))])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", [jax.jit, lambda f: f], ids=["jit", "eager"])
def test_wrap_lands_inside_a_whole_number_of_turns_away(dtype, mode):
    rng = np.random.default_rng(0)
    a = np.concatenate([rng.uniform(-200, 200, 500).astype(dtype), around_the_seams(dtype)])
    w = np.asarray(mode(wrap)(a))
    assert w.dtype == dtype
    assert np.all(w > -dtype(np.pi)) and np.all(w <= dtype(np.pi))
    turns = (a.astype(np.float64) - w) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=200 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", [jax.jit, lambda f: f], ids=["jit", "eager"])
def test_wrap_returns_an_angle_already_inside_bit_for_bit(dtype, mode):
    pi = dtype(np.pi)
    inside = np.concatenate(
        [np.linspace(-3.14, 3.14, 1001).astype(dtype)]
        + [np.array([pi, np.nextafter(pi, dtype(0)), np.nextafter(-pi, dtype(0)), 0, 1e-30], dtype)]
    )
    assert np.array_equal(np.asarray(mode(wrap)(inside)), inside)
    assert wrap(-pi) == pi


def test_wrap_of_an_angle_without_a_remainder_is_inside():
    for dtype, sizes in ((np.float32, [1e8, 4e9, 3e38]), (np.float64, [1e17, 1e30, 1e61, 1e300])):
        w = np.asarray(wrap(np.array(sizes + [-size for size in sizes], dtype)))
        assert w.dtype == dtype and (np.abs(w) <= dtype(np.pi)).all()


def test_wrap_has_slope_one_everywhere():
    a = around_the_seams(np.float64)
    slope = jax.jit(jax.vmap(jax.grad(wrap)))(a)
    assert np.array_equal(slope, np.ones_like(a))


def test_wrap_takes_any_shape_and_more_than_one_turn():
    a = np.array([[7.0, -7.0, 100.0], [3 * np.pi, -3 * np.pi, 0.5]])
    expected = [[7 - 2 * np.pi, 2 * np.pi - 7, 100 - 32 * np.pi], [np.pi, np.pi, 0.5]]
    np.testing.assert_allclose(wrap(a), expected, atol=1e-13)


def exact_sinc(x, derivative=0):
    """The derivative-th derivative of sin(x)/x by its power series in exact rational arithmetic."""
    x, total = Fraction(float(x)), Fraction(0)
    for k in range(60):
        if 2 * k < derivative:
            continue
        coefficient = Fraction((-1) ** k, math.factorial(2 * k + 1))
        coefficient *= Fraction(math.factorial(2 * k), math.factorial(2 * k - derivative))
        total += coefficient * x ** (2 * k - derivative)
    return float(total)


HARD = [0.0, 1e-300, 1e-9, -1e-9, 1e-4, 0.1, 0.499, 0.4999999, 0.5, 0.501, -0.499, -0.501, 1.0, 3.0]


@pytest.mark.parametrize(
    ("function", "order", "atol"),
    [
        (sinc, 0, 1e-15),
        (sinc_slope, 1, 5e-15),
        (jax.grad(sinc), 1, 5e-15),
        (jax.grad(sinc_slope), 2, 1e-13),
        (jax.grad(jax.grad(sinc)), 2, 1e-13),
    ],
    ids=["sinc", "slope", "sinc'", "slope'", "sinc''"],
)
def test_sinc_and_its_derivatives_equal_the_exact_series(function, order, atol):
    x = np.array(HARD)
    expected = [exact_sinc(a, order) for a in x]
    np.testing.assert_allclose(jax.jit(jax.vmap(function))(x), expected, rtol=0, atol=atol)


@pytest.mark.parametrize("function", [sinc, sinc_slope])
def test_sinc_in_float32_is_finite_and_close(function):
    x = np.array([*HARD, 1e-30, 0.5, 20.0], np.float32)
    order = 0 if function is sinc else 1
    out, slope = jax.jit(jax.vmap(jax.value_and_grad(function)))(x)
    assert out.dtype == np.float32
    np.testing.assert_allclose(out, [exact_sinc(a, order) for a in x], rtol=0, atol=1e-6)
    np.testing.assert_allclose(slope, [exact_sinc(a, order + 1) for a in x], rtol=0, atol=2e-5)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sin_cos_are_those_of_numpy(dtype):
    """Near and far, at the seams of the reduction, and of what is no angle; and their slopes."""
    random = np.random.default_rng(0)
    x = [random.uniform(-size, size, 2000) for size in (1.0, 10.0, 1e6)]
    x += [np.arange(-41, 42) * np.pi / 4, [0.0, -0.0, 1e-300, -1e-9]]
    x = np.concatenate(x).astype(dtype)
    (s, c), (ds, dc) = jax.jit(lambda *x: jax.jvp(sin_cos, x[:1], x[1:]))(x, np.ones_like(x))
    assert s.dtype == c.dtype == dtype
    atol = 1.2 * np.finfo(dtype).eps
    for found, exact in ((s, np.sin(x)), (c, np.cos(x)), (ds, np.cos(x)), (dc, -np.sin(x))):
        np.testing.assert_allclose(found, exact, atol=atol, rtol=0)
    lost = np.array([1e17, -1e30, np.inf, np.nan], dtype)
    found = np.asarray(jax.jit(sin_cos)(lost))
    assert (np.abs(found[:, :2]) <= 1).all() and np.isnan(found[:, 2:]).all()
