"""Angle wrapping, sine and cosine together, and sin(x)/x with its derivative."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxslam.math._series import horner
from jaxslam.math._xla import traced_once

__all__ = ["sin_cos", "sinc", "sinc_slope", "wrap"]

# Below this the power series is used. There the first term dropped from it and from its first two
# derivatives is under 1e-16, and above it the closed form loses at most a digit to cancellation.
_SERIES = 0.5

# π/2 in three parts, of which whole multiples up to 2²⁰ of the first two are exact (Cody and Waite
# 1980, "Software manual for the elementary functions"); Taylor's series in x² of sin(x)/x - 1 and
# cos(x) - 1, whose remainders are below 1e-17 for |x| <= π/4.
_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SINE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(1, 9)]
_COSINE = [(-1) ** k / math.factorial(2 * k) for k in range(1, 9)]


@traced_once
def wrap(angle: ArrayLike) -> jax.Array:
    """Wrap an angle to (-π, π] by whole turns: a - 2π⌈(a - π)/2π⌉.

    Any shape, radians. An angle already inside is returned unchanged, bit for bit. The derivative
    is 1 everywhere, also at the seam. Of an angle so large (10¹⁶ in float64) that rounding leaves
    nothing of it modulo 2π the result is 0. (Solà's code corrects by one turn only; errata.)
    """
    a = jnp.asarray(angle)
    w = a - 2 * np.pi * jnp.ceil((a - np.pi) / (2 * np.pi))
    # Rounding of the quotient may leave a whole turn too many or too few beside the seam.
    w = jnp.where(w > np.pi, w - 2 * np.pi, jnp.where(w <= -np.pi, w + 2 * np.pi, w))
    return jnp.where(jnp.abs(w) > np.pi, 0.0, w)


@jax.custom_jvp
def sin_cos(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(sin x, cos x), to a unit in the last place of numbers up to 10⁶.

    In float64 by polynomials, which a CPU computes for eight numbers at once, where XLA calls the C
    library for each: a third of the time over many numbers, and more to compile. In other
    precisions those of `jnp`. Of an angle so large (10¹⁶) that rounding leaves nothing of it the
    result is (0, ±1).
    """
    if x.dtype != jnp.float64:
        return jnp.sin(x), jnp.cos(x)
    turns = jnp.round(x * (2 / np.pi))
    rest = x
    for part in _HALF_PI:
        rest = rest - turns * part
    rest = jnp.where(jnp.abs(rest) > 1, 0.0, rest)
    square = rest * rest
    sine = rest + rest * (square * horner(square, _SINE))
    cosine = 1 + square * horner(square, _COSINE)
    # (sin, cos) after 0 to 3 quarter turns: (s, c), (c, -s), (-s, -c), (-c, s).
    quarter = turns - 4 * jnp.floor(turns / 4)
    odd = (quarter == 1) | (quarter == 3)
    s, c = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(quarter >= 2, -s, s), jnp.where((quarter == 1) | (quarter == 2), -c, c)


@sin_cos.defjvp
def _(
    primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    s, c = sin_cos(*primals)
    return (s, c), (c * tangents[0], -s * tangents[0])


@traced_once
def sinc(x: ArrayLike) -> jax.Array:
    """sin(x)/x, smooth through 0 with all its derivatives (`jnp.sinc` loses them near 0)."""
    x = jnp.asarray(x)
    small = jnp.abs(x) < _SERIES
    x2 = jnp.where(small, x, 0.0) ** 2
    series = horner(x2, [(-1) ** k / math.factorial(2 * k + 1) for k in range(8)])
    far = jnp.where(small, 1.0, x)
    return jnp.where(small, series, jnp.sin(far) / far)


def sinc_slope(x: ArrayLike) -> jax.Array:
    """d/dx sin(x)/x = (cos x - sin(x)/x)/x, smooth through 0; used by hand-derived Jacobians."""
    x = jnp.asarray(x)
    small = jnp.abs(x) < _SERIES
    near = jnp.where(small, x, 0.0)
    series = near * horner(
        near**2, [(-1) ** k * 2 * k / math.factorial(2 * k + 1) for k in range(1, 8)]
    )
    far = jnp.where(small, 1.0, x)
    return jnp.where(small, series, (jnp.cos(far) - jnp.sin(far) / far) / far)
