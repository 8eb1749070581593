"""Angle wrapping, and sin(x)/x with its derivative, accurate near zero."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

# Below this the power series is used. There the first term dropped from it and from its first two
# derivatives is under 1e-16, and above it the closed form loses at most a digit to cancellation.
_SERIES = 0.5


def wrap(angle: ArrayLike) -> jax.Array:
    """Wrap an angle to (-π, π] by whole turns: a - 2π⌈(a - π)/2π⌉.

    Any shape, radians. An angle already inside is returned unchanged, bit for bit. The derivative
    is 1 everywhere, also at the seam. Of an angle so large (10¹⁶ in float64) that rounding leaves
    nothing of it modulo 2π the result is 0. (Solà's code corrects by one turn only; see ERRATA.)
    """
    a = jnp.asarray(angle)
    w = a - 2 * np.pi * jnp.ceil((a - np.pi) / (2 * np.pi))
    # Rounding of the quotient may leave a whole turn too many or too few beside the seam.
    w = jnp.where(w > np.pi, w - 2 * np.pi, jnp.where(w <= -np.pi, w + 2 * np.pi, w))
    return jnp.where(jnp.abs(w) > np.pi, 0.0, w)


def sinc(x: ArrayLike) -> jax.Array:
    """sin(x)/x, smooth through 0 with all its derivatives (`jnp.sinc` loses them near 0)."""
    x = jnp.asarray(x)
    small = jnp.abs(x) < _SERIES
    x2 = jnp.where(small, x, 0.0) ** 2
    series = _horner(x2, [(-1) ** k / math.factorial(2 * k + 1) for k in range(8)])
    far = jnp.where(small, 1.0, x)
    return jnp.where(small, series, jnp.sin(far) / far)


def sinc_slope(x: ArrayLike) -> jax.Array:
    """d/dx sin(x)/x = (cos x - sin(x)/x)/x, smooth through 0; used by hand-derived Jacobians."""
    x = jnp.asarray(x)
    small = jnp.abs(x) < _SERIES
    near = jnp.where(small, x, 0.0)
    series = near * _horner(
        near**2, [(-1) ** k * 2 * k / math.factorial(2 * k + 1) for k in range(1, 8)]
    )
    far = jnp.where(small, 1.0, x)
    return jnp.where(small, series, (jnp.cos(far) - jnp.sin(far) / far) / far)


def _horner(x: jax.Array, coefficients: list[float]) -> jax.Array:
    total = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total
