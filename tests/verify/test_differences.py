"""Difference quotients: their values, estimated errors, kinks, circles, and the complex step."""

import jax.numpy as jnp
import numpy as np

from jaxslam.verify import differences, verify_jacobians


def smooth(x):
    return np.stack([np.sin(x[:, 0]) * np.exp(x[:, 1]), x[:, 0] ** 3 / x[:, 1]], axis=1)


def smooth_jacobian(x):
    a, b = x[:, 0], x[:, 1]
    return np.stack(
        [
            np.stack([np.cos(a) * np.exp(b), np.sin(a) * np.exp(b)], axis=1),
            np.stack([3 * a**2 / b, -(a**3) / b**2], axis=1),
        ],
        axis=1,
    )


def test_quotients_and_their_error():
    rng = np.random.default_rng(0)
    x = np.stack([rng.normal(size=50), rng.uniform(1, 2, 50)], axis=1)
    value, error, kink = differences.quotients(smooth, (x,), 0, np.full(2, np.inf))
    off = np.abs(value - smooth_jacobian(x))
    assert off.max() < 1e-10
    assert error.max() < 1e-8
    assert np.all(off <= 10 * error)
    assert not kink.any()


def test_quotients_know_where_there_is_no_derivative():
    x = np.array([[0.0], [1e-9], [1.0]])

    def root(x):
        return np.sqrt(np.abs(x))

    value, error, kink = differences.quotients(root, (x,), 0, np.full(1, np.inf))
    assert np.all(~(error[:2, 0, 0] < 1e-3 * np.abs(value[:2, 0, 0])))
    np.testing.assert_allclose(value[2, 0, 0], 0.5, atol=1e-10)


def test_quotients_cross_the_seam_of_a_circle():
    def wrapped(x):
        return np.angle(np.exp(1j * 2 * x))

    x = np.array([[np.pi / 2], [-np.pi / 2 + 1e-9], [0.3]])
    value, _, kink = differences.quotients(wrapped, (x,), 0, np.array([2 * np.pi]))
    np.testing.assert_allclose(value, 2, atol=1e-9)
    assert not kink.any()


def test_quotients_see_a_kink_where_they_converge():
    def f(x):
        return np.stack([np.abs(x[:, 0]), x[:, 0] * np.abs(x[:, 0])], axis=1)

    value, error, kink = differences.quotients(
        f, (np.array([[0.0], [1e-3]]),), 0, np.full(2, np.inf)
    )
    np.testing.assert_array_equal(kink[:, :, 0], [[True, False], [False, False]])


def test_a_fast_turn_is_not_aliased():
    def heading(x):
        return np.angle(np.exp(1j * 1000 * x))

    value, _, _ = differences.quotients(heading, (np.array([[0.3]]),), 0, np.array([2 * np.pi]))
    np.testing.assert_allclose(value, 1000, rtol=1e-7)


def test_complex_step_is_exact():
    x = np.array([[0.7, 1.3]])
    np.testing.assert_allclose(
        differences.complex_step(smooth, (x,), 0), smooth_jacobian(x), rtol=1e-15
    )


def test_complex_step_is_used_where_the_function_allows_it():
    def analytic(point):
        return jnp.stack([point[0] * jnp.sin(point[1])])

    def not_analytic(point):  # takes complex numbers, and loses the imaginary part
        return jnp.stack([point[0] * jnp.sin(jnp.real(point[1])), point[0]])

    assert verify_jacobians(analytic).findings[0].quotient == "complex step"
    report = verify_jacobians(not_analytic)
    assert report.findings[0].quotient == "differences"
    assert report.passed
