"""The Cholesky factor of a small matrix, unrolled, its solutions, and other square roots.

A landmark update factors a 2×2 to 6×6 matrix, millions of times, under `vmap`. The library call
behind `jnp.linalg.cholesky` costs more there than the arithmetic, and hides a non-positive pivot
behind NaN; hence the unrolled factor below, which reports it and stays finite. `root_psd` and
`triangular_root` are for covariances of any size.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, PyTree

from jaxslam.math._linalg import batched
from jaxslam.math._xla import traced_once

UNROLLED = 8
"""Up to this size factors are unrolled into fused elementwise code; beyond it see `batched`."""


def pivot_tolerance(matrix: jax.Array) -> float:
    """The relative rounding of a sum of n terms, n·eps; a pivot is compared with its `sizes`."""
    return matrix.shape[-1] * float(jnp.finfo(matrix.dtype).eps)


def _sizes(matrix: Float[Array, "n n"], factor: Float[Array, "n n"]) -> Float[Array, "n"]:
    """The numbers s_j that n·eps times is the rounding error of pivot p_j of a factor L.

        s_j = a_jj + Σ_k L_jk² s_k / p_k

    An earlier pivot of few digits makes L_jk as uncertain. Without the sum a fifth of the
    singular matrices of rank n - 1 > 1 is taken for regular. Here by three terms of the series,
    which leave one in a thousand.
    """
    pivot = jnp.diagonal(factor) ** 2
    by_earlier = jnp.tril(factor, -1) ** 2 / jnp.where(pivot > 0, pivot, 1.0)[None, :]
    diagonal = jnp.abs(jnp.diagonal(matrix))
    size = diagonal
    for _ in range(3):
        size = diagonal + (by_earlier * size[None, :]).sum(axis=1)
    return size


def cholesky(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """Lower L (n, n) with L Lᵀ = A, and whether A is numerically positive definite, ().

    A pivot not above its rounding error, n·eps times its diagonal entry and more after small pivots
    (`_sizes`), counts as zero: its column of L is zero and the flag is False, so that a positive
    *semi*-definite A still gets a usable square root, and nothing becomes NaN (beyond 8×8, the
    whole L is then zero). Only the lower triangle is read. Non-finite input gives False.
    """
    n = matrix.shape[-1]
    if n == 0:
        return matrix, jnp.asarray(True)
    if n > UNROLLED:
        factor = _factor(mirror(matrix))
        return factor, factor[0, 0] > 0
    return _cholesky(matrix)


@jax.custom_jvp
@traced_once
def _cholesky(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    n, tolerance = matrix.shape[-1], pivot_tolerance(matrix)
    zero = jnp.zeros((), matrix.dtype)
    rows: list[list[jax.Array]] = [[zero] * n for _ in range(n)]
    positive = jnp.asarray(True)
    ratios: list[jax.Array] = []  # s_k / p_k of `_sizes`, exactly, since the loop has them in order
    for j in range(n):
        squares = [rows[j][k] ** 2 for k in range(j)]
        pivot = matrix[j, j] - sum(squares, zero)
        size = jnp.abs(matrix[j, j])
        size = size + sum((s * q for s, q in zip(squares, ratios, strict=True)), zero)
        good = pivot > tolerance * size
        positive = positive & good
        ratios.append(jnp.where(good, size / jnp.where(good, pivot, 1.0), 0.0))
        # 1 in place of a bad pivot: √ and division keep finite derivatives in the unused branch.
        root = jnp.sqrt(jnp.where(good, pivot, 1.0))
        rows[j][j] = jnp.where(good, root, 0.0)
        for i in range(j + 1, n):
            rest = matrix[i, j] - sum((rows[i][k] * rows[j][k] for k in range(j)), zero)
            rows[i][j] = jnp.where(good, rest / root, 0.0)
    return jnp.stack([jnp.stack(row) for row in rows]), positive


@_cholesky.defjvp
def _cholesky_slope(primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    """dL = L Φ(L⁻¹ dA L⁻ᵀ); the column of a zero pivot stays zero, with 1 used in its place."""
    factor, positive = _cholesky(*primals)
    good = jnp.diagonal(factor) > 0
    # 1 on the diagonal of a zero column, so that L is regular; its slope is masked below.
    regular = factor + jnp.diag((~good).astype(factor.dtype))
    inner = solve_lower(regular, solve_lower(regular, mirror(tangents[0])).T)
    slope = regular @ jnp.where(good, lower_half(inner), 0.0)
    return (factor, positive), (slope, np.zeros(positive.shape, jax.dtypes.float0))


def mirror(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """The symmetric matrix with this lower triangle."""
    return jnp.tril(matrix) + jnp.tril(matrix, -1).T


def lower_half(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Φ(A): the lower triangle of A with half of the diagonal."""
    return jnp.tril(matrix) - 0.5 * jnp.diag(jnp.diagonal(matrix))


@jax.custom_jvp
def _factor(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower L with L Lᵀ = A of a symmetric A; all zero if a pivot is numerically zero."""
    factor = jnp.tril(batched.factor(matrix))
    positive = jnp.all(jnp.diagonal(factor) ** 2 > pivot_tolerance(matrix) * _sizes(matrix, factor))
    return jnp.where(positive, factor, 0.0)


@_factor.defjvp
def _factor_slope(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
    """dL = L Φ(L⁻¹ dA L⁻ᵀ), where Φ keeps the lower triangle and half of the diagonal."""
    factor = _factor(*primals)
    regular = factor[0, 0] > 0
    safe = jnp.where(regular, factor, jnp.eye(len(factor), dtype=factor.dtype))
    inner = batched.solve_lower(safe, batched.solve_lower(safe, tangents[0]).T)
    slope = safe @ lower_half(inner)
    return factor, jnp.where(regular, slope, 0.0)


def solve_lower(
    factor: Float[Array, "n n"], rhs: Float[Array, "n *rest"]
) -> Float[Array, "n *rest"]:
    """The solution L⁻¹ B for lower L (n, n), B (n, …), with rows of zeros where a pivot is zero."""
    n = factor.shape[-1]
    if n == 0:
        return rhs
    if n > UNROLLED:
        singular = jnp.diagonal(factor) == 0
        safe = factor + jnp.diag(singular.astype(factor.dtype))
        out = batched.solve_lower(safe, rhs.reshape(n, -1))
        return jnp.where(singular[:, None], 0.0, out).reshape(rhs.shape)

    # Substitution is unrolled; the derivative is one more solution, not that of each of its steps.
    def lower(x: jax.Array) -> jax.Array:
        return jnp.tensordot(jnp.tril(factor), x, 1)

    solution: jax.Array = jax.lax.custom_linear_solve(
        lower,
        rhs,
        lambda _, b: _substitute(factor, b),
        transpose_solve=lambda _, b: _substitute(factor[::-1, ::-1].T, b[::-1])[::-1],
    )
    return solution


@traced_once
def _substitute(
    factor: Float[Array, "n n"], rhs: Float[Array, "n *rest"]
) -> Float[Array, "n *rest"]:
    """L⁻¹ B by forward substitution, unrolled."""
    rows: list[jax.Array] = []
    for i in range(len(factor)):
        rest = rhs[i] - sum((factor[i, k] * rows[k] for k in range(i)), jnp.zeros_like(rhs[i]))
        pivot = factor[i, i]
        rows.append(rest * jnp.where(pivot > 0, 1.0 / jnp.where(pivot > 0, pivot, 1.0), 0.0))
    return jnp.stack(rows)


def solve_psd(
    matrix: Float[Array, "n n"], rhs: Float[Array, "n *rest"]
) -> tuple[Float[Array, "n *rest"], Bool[Array, ""]]:
    """The solution A⁻¹ B for A (n, n) and B (n, …), and whether A is positive definite."""
    factor, positive = cholesky(matrix)
    reverse = factor[::-1, ::-1].T
    return solve_lower(reverse, solve_lower(factor, rhs)[::-1])[::-1], positive


@traced_once
def root_psd(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower L (n, n) with L Lᵀ = A for a positive semi-definite A of any size, singular or not.

    Cholesky column by column; a pivot that is rounding next to its diagonal entry gives a column of
    zeros. Gradients are finite.
    """
    n = matrix.shape[-1]
    if n == 0:
        return matrix
    # n·eps of the diagonal entry: the rounding of the n subtractions that lead to a pivot.
    floor = n * float(jnp.finfo(matrix.dtype).eps) * jnp.abs(jnp.diagonal(matrix))

    def column(rest: jax.Array, j: jax.Array) -> tuple[jax.Array, jax.Array]:
        pivot = rest[j, j]
        good = pivot > floor[j]
        root = jnp.sqrt(jnp.where(good, pivot, 1.0))
        values = jnp.where(good & (jnp.arange(n) >= j), rest[:, j] / root, 0.0)
        return rest - values[:, None] * values[None, :], values

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
        nonzero = square > 0
        length = jnp.sqrt(jnp.where(nonzero, square, 1.0))
        # To -sign(a_i)·length, away from where a_i - length would cancel; then the sign is turned.
        sign = jnp.where(ahead[i] >= 0, 1.0, -1.0).astype(rest.dtype)
        axis = ahead.at[i].add(sign * length)
        scale = jnp.where(nonzero, 1.0 / (length * (length + jnp.abs(ahead[i]))), 0.0)
        rest = rest - (rest @ axis * scale)[:, None] * axis[None, :]
        return rest.at[:, i].multiply(jnp.where(nonzero, -sign, 1.0)), None

    return jnp.tril(jax.lax.scan(reflect, wide, jnp.arange(n))[0][:, :n])
