"""Inverses of small matrices, and of their Cholesky factors."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, PyTree

from jaxslam.math._linalg import batched
from jaxslam.math._linalg.factors import (
    UNROLLED,
    cholesky,
    lower_half,
    mirror,
    pivot_tolerance,
    solve_lower,
)
from jaxslam.math._linalg.products import self_gram, total
from jaxslam.math._xla import traced_once


@jax.custom_jvp
@traced_once
def whitener(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """The inverse Cholesky factor W = L⁻¹ (n, n) of a small A = L Lᵀ, and `cholesky`'s flag.

    A pivot that counts as zero gives a row of zeros. It takes one division and one square root a
    pivot, where `cholesky` and `solve_lower` take three.
    """
    n, tolerance = matrix.shape[-1], pivot_tolerance(matrix)
    zero = jnp.zeros((), matrix.dtype)
    factor = [[zero] * n for _ in range(n)]
    rows = [[zero] * n for _ in range(n)]
    positive = jnp.asarray(True)
    ratios: list[jax.Array] = []  # s_k / p_k of `factors._sizes`
    for j in range(n):
        squares = [factor[j][k] ** 2 for k in range(j)]
        pivot = matrix[j, j] - sum(squares, zero)
        size = jnp.abs(matrix[j, j])
        size = size + sum((s * q for s, q in zip(squares, ratios, strict=True)), zero)
        good = pivot > tolerance * size
        positive = positive & good
        rows[j][j] = jnp.where(good, jax.lax.rsqrt(jnp.where(good, pivot, 1.0)), 0.0)
        ratios.append(size * rows[j][j] ** 2)
        for k in range(j):
            # Row j of L W = 1, solved for W_jk.
            rows[j][k] = -rows[j][j] * total(factor[j][i] * rows[i][k] for i in range(k, j))
        for i in range(j + 1, n):
            rest = matrix[i, j] - sum((factor[i][k] * factor[j][k] for k in range(j)), zero)
            factor[i][j] = jnp.where(good, rest * rows[j][j], 0.0)
    return jnp.stack([jnp.stack(row) for row in rows]), positive


@whitener.defjvp
def _whitener_slope(primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    """dW = -Φ(W dA Wᵀ) W, with rows and columns of zeros where a pivot is zero."""
    white, positive = whitener(*primals)
    slope = -lower_half(white @ mirror(tangents[0]) @ white.T) @ white
    return (white, positive), (slope, np.zeros(positive.shape, jax.dtypes.float0))


def whitener_by_rows(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """The inverse Cholesky factor by a loop over rows, which compiles faster than `whitener`.

    Beyond 8×8 by `cholesky`, and all zero if a pivot is zero.
    """
    n, tolerance = matrix.shape[-1], pivot_tolerance(matrix)
    if n == 0:
        return matrix, jnp.asarray(True)
    if n > UNROLLED:
        factor, positive = cholesky(matrix)
        return solve_lower(factor, jnp.eye(n, dtype=matrix.dtype)), positive
    index = jnp.arange(n)

    def row(carry: PyTree, j: jax.Array) -> tuple[PyTree, PyTree]:
        rest, ahead, size = carry
        pivot = rest[j, j]
        good = pivot > tolerance * size[j]
        scale = jnp.where(good, jax.lax.rsqrt(jnp.where(good, pivot, 1.0)), 0.0)
        # Elimination of [A 1]: row j of what began as the identity ends as row j of L⁻¹.
        below, scaled = jnp.where(index > j, rest[:, j] * scale, 0.0), ahead[j] * scale
        return (
            rest - below[:, None] * below[None, :],
            ahead - below[:, None] * scaled[None, :],
            size + jax.lax.stop_gradient(below**2 * (size[j] * scale**2)),
        ), (scaled, good)

    eye, size = jnp.eye(n, dtype=matrix.dtype), jax.lax.stop_gradient(jnp.abs(jnp.diag(matrix)))
    # Sizes only decide which pivots count as zero, so no gradient goes through them.
    rows, good = jax.lax.scan(row, (matrix, eye, size), index)[1]
    return rows, good.all()


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a regular (n, n) matrix: by cofactors up to 3×3, which fuses; by LU beyond."""
    n = matrix.shape[-1]
    a = matrix
    if n == 1:
        return jnp.reciprocal(a)
    if n == 2:
        det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        return jnp.stack([jnp.stack([a[1, 1], -a[0, 1]]), jnp.stack([-a[1, 0], a[0, 0]])]) / det
    if n == 3:
        # The columns of adj A are cross products of the rows of A; det A = a_0 · (a_1 × a_2).
        cofactors = jnp.stack(
            [jnp.cross(a[1], a[2]), jnp.cross(a[2], a[0]), jnp.cross(a[0], a[1])], axis=1
        )
        return cofactors / jnp.dot(a[0], cofactors[:, 0])
    return batched.inverse(a)


def inverse_psd(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A⁻¹ of a positive definite A (n, n), exactly symmetric; zero where A is not (n > 8)."""
    return self_gram(whitener_by_rows(matrix)[0])
