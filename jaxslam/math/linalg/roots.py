"""Square roots of covariances of any size: of a semi-definite matrix, and triangular ones."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxslam.math.xla import traced_once


@traced_once
def root_psd(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower L (n, n) with L Lᵀ = A for a positive semi-definite A of any size, singular or not.

    Cholesky column by column; a pivot that is rounding next to its diagonal entry gives a column of
    zeros. Gradients are finite.
    """
    n = matrix.shape[-1]
    if n == 0:
        return matrix
    floor = n * float(jnp.finfo(matrix.dtype).eps) * jnp.abs(jnp.diagonal(matrix))

    def column(rest: jax.Array, j: jax.Array) -> tuple[jax.Array, jax.Array]:
        pivot = rest[j, j]
        good = pivot > floor[j]
        root = jnp.sqrt(jnp.where(good, pivot, 1.0))
        own = jnp.where(good & (jnp.arange(n) >= j), rest[:, j] / root, 0.0)
        return rest - own[:, None] * own[None, :], own

    return jax.lax.scan(column, matrix, jnp.arange(n))[1].T


def triangular_root(wide: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """Lower L (n, n) with L Lᵀ = A Aᵀ and a diagonal not below zero, of A (n, m), m >= n.

    Householder reflections from the right, row by row. A Aᵀ is not formed, so half the digits of a
    covariance suffice. A may be rank deficient, and gradients are finite there.
    """
    n, m = wide.shape

    def reflect(rest: jax.Array, i: jax.Array) -> tuple[jax.Array, None]:
        ahead = jnp.where(jnp.arange(m) >= i, rest[i], 0.0)
        square = jnp.sum(ahead**2)
        there = square > 0
        length = jnp.sqrt(jnp.where(there, square, 1.0))
        # To -sign(a_i)·length, away from where a_i - length would cancel; then the sign is turned.
        sign = jnp.where(ahead[i] >= 0, 1.0, -1.0).astype(rest.dtype)
        axis = ahead.at[i].add(sign * length)
        scale = jnp.where(there, 1.0 / (length * (length + jnp.abs(ahead[i]))), 0.0)
        rest = rest - (rest @ axis * scale)[:, None] * axis[None, :]
        return rest.at[:, i].multiply(jnp.where(there, -sign, 1.0)), None

    return jnp.tril(jax.lax.scan(reflect, wide, jnp.arange(n))[0][:, :n])
