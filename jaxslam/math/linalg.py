"""Small linear algebra: products, Cholesky factors and inverses of a filter's small matrices.

A landmark update factors a 2×2 to 6×6 matrix, millions of times, under `vmap`. The library call
behind `jnp.linalg.cholesky` costs more there than the arithmetic, and hides a non-positive pivot
behind NaN; hence the unrolled factor below, which reports it and stays finite.
"""

import functools
import operator
from collections.abc import Callable, Iterable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, PyTree

from jaxslam.math import batched_linalg
from jaxslam.math.xla import traced_once

_T = TypeVar("_T")

# Up to this many rows a product AᵀB is written as outer products, which XLA fuses into one pass
# over the result; beyond, as one matrix product.
_OUTER_PRODUCTS = 16

# Up to this size factors are unrolled into fused elementwise code; beyond it see `batched_linalg`.
_UNROLLED = 8


def _tolerance(matrix: jax.Array) -> float:
    """The relative tolerance of a pivot: n·eps of its diagonal entry, the size of rounding."""
    return matrix.shape[-1] * float(jnp.finfo(matrix.dtype).eps)


def total(terms: Iterable[jax.Array]) -> jax.Array:
    """The sum of at least one array, unrolled, so that it fuses into one elementwise kernel."""
    return functools.reduce(operator.add, terms)


def kept_whole(function: Callable[..., _T]) -> Callable[..., _T]:
    """The function, rematerialized in reverse mode: only its arguments are stored.

    Unrolled code would otherwise store one array of the whole loop for each entry.
    """
    # Within a scan or a batch XLA does not merge the recomputation with the original.
    return jax.checkpoint(function, prevent_cse=False)


def gram(a: Float[Array, "k D"], b: Float[Array, "k E"]) -> Float[Array, "D E"]:
    """Aᵀ B of A (k, D), B (k, E), for small k."""
    if a.shape[0] > _OUTER_PRODUCTS or a.shape[0] == 0:
        # Not a.T @ b, for which a gradient would store a transposed copy of A.
        return jax.lax.dot_general(a, b, (((0,), (0,)), ((), ())))
    return _outer_products(a, b)


@kept_whole
def _outer_products(a: Float[Array, "k D"], b: Float[Array, "k E"]) -> Float[Array, "D E"]:
    return total(a[k, :, None] * b[k, None, :] for k in range(a.shape[0]))


@jax.custom_jvp
def self_gram(a: Float[Array, "k D"]) -> Float[Array, "D D"]:
    """Aᵀ A of A (k, D), k of any size; one product in a gradient, where `gram` takes two."""
    return gram(a, a)


@self_gram.defjvp
def _square_slope(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
    half = gram(tangents[0], primals[0])
    return self_gram(*primals), half + half.T


def gram_both(a: Float[Array, "k D"], b: Float[Array, "k D"]) -> Float[Array, "D D"]:
    """Aᵀ B + Bᵀ A of A, B (k, D), for small k; symmetric to the bit."""
    return gram(a, b) + gram(b, a)


def matmul(a: Float[Array, "n k"], b: Float[Array, "k D"]) -> Float[Array, "n D"]:
    """A B of A (n, k), B (k, D), for small k."""
    return gram(a.T, b)


def symmetrize(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """(A + Aᵀ)/2 over the last two axes."""
    return 0.5 * (matrix + jnp.swapaxes(matrix, -1, -2))


def cholesky(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """Lower L (n, n) with L Lᵀ = A, and whether A is numerically positive definite, ().

    A pivot not above n·eps times its diagonal entry counts as zero: its column of L is zero and the
    flag is False, so that a positive *semi*-definite A still gets a usable square root, and nothing
    becomes NaN (beyond 8×8, the whole L is then zero). Only the lower triangle is read. Non-finite
    input gives False.
    """
    n = matrix.shape[-1]
    if n == 0:
        return matrix, jnp.asarray(True)
    return _cholesky_beyond(matrix) if n > _UNROLLED else _cholesky(matrix)


@jax.custom_jvp
@traced_once
def _cholesky(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    n, tolerance = matrix.shape[-1], _tolerance(matrix)
    zero = jnp.zeros((), matrix.dtype)
    rows: list[list[jax.Array]] = [[zero] * n for _ in range(n)]
    positive = jnp.asarray(True)
    for j in range(n):
        pivot = matrix[j, j] - sum((rows[j][k] ** 2 for k in range(j)), zero)
        good = pivot > tolerance * jnp.abs(matrix[j, j])
        positive = positive & good
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
    regular = factor + jnp.diag((~good).astype(factor.dtype))
    inner = solve_lower(regular, solve_lower(regular, _mirrored(tangents[0])).T)
    slope = regular @ jnp.where(good, _lower_half(inner), 0.0)
    return (factor, positive), (slope, np.zeros(positive.shape, jax.dtypes.float0))


def _mirrored(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """The symmetric matrix with this lower triangle."""
    return jnp.tril(matrix) + jnp.tril(matrix, -1).T


def _lower_half(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Φ(A): the lower triangle of A with half of the diagonal."""
    return jnp.tril(matrix) - 0.5 * jnp.diag(jnp.diagonal(matrix))


def _cholesky_beyond(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    factor = _factor(_mirrored(matrix))
    return factor, factor[0, 0] > 0


@jax.custom_jvp
def _factor(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower L with L Lᵀ = A of a symmetric A; all zero if a pivot is numerically zero."""
    factor = jnp.tril(batched_linalg.factor(matrix))
    positive = jnp.all(
        jnp.diagonal(factor) ** 2 > _tolerance(matrix) * jnp.abs(jnp.diagonal(matrix))
    )
    return jnp.where(positive, factor, 0.0)


@_factor.defjvp
def _factor_slope(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
    """dL = L Φ(L⁻¹ dA L⁻ᵀ), where Φ keeps the lower triangle and half of the diagonal."""
    factor = _factor(*primals)
    regular = factor[0, 0] > 0
    safe = jnp.where(regular, factor, jnp.eye(len(factor), dtype=factor.dtype))
    inner = batched_linalg.solve_lower(safe, batched_linalg.solve_lower(safe, tangents[0]).T)
    slope = safe @ _lower_half(inner)
    return factor, jnp.where(regular, slope, 0.0)


def solve_lower(
    factor: Float[Array, "n n"], rhs: Float[Array, "n *rest"]
) -> Float[Array, "n *rest"]:
    """L⁻¹ B for lower L (n, n) and B (n, …), with rows of zeros where a pivot is zero."""
    n = factor.shape[-1]
    if n == 0:
        return rhs
    if n > _UNROLLED:
        singular = jnp.diagonal(factor) == 0
        safe = factor + jnp.diag(singular.astype(factor.dtype))
        out = batched_linalg.solve_lower(safe, rhs.reshape(n, -1))
        return jnp.where(singular[:, None], 0.0, out).reshape(rhs.shape)

    def lower(x: jax.Array) -> jax.Array:
        return jnp.tensordot(jnp.tril(factor), x, 1)

    solution: jax.Array = jax.lax.custom_linear_solve(
        lower,
        rhs,
        lambda _, b: _substituted(factor, b),
        transpose_solve=lambda _, b: _substituted(factor[::-1, ::-1].T, b[::-1])[::-1],
    )
    return solution


@traced_once
def _substituted(
    factor: Float[Array, "n n"], rhs: Float[Array, "n *rest"]
) -> Float[Array, "n *rest"]:
    """L⁻¹ B by forward substitution, unrolled."""
    rows: list[jax.Array] = []
    for i in range(len(factor)):
        rest = rhs[i] - sum((factor[i, k] * rows[k] for k in range(i)), jnp.zeros_like(rhs[i]))
        pivot = factor[i, i]
        rows.append(rest * jnp.where(pivot > 0, 1.0 / jnp.where(pivot > 0, pivot, 1.0), 0.0))
    return jnp.stack(rows)


@jax.custom_jvp
@traced_once
def whitener(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """The inverse Cholesky factor W = L⁻¹ (n, n) of a small A = L Lᵀ, and `cholesky`'s flag.

    A pivot that counts as zero gives a row of zeros. It takes one division and one square root a
    pivot, where `cholesky` and `solve_lower` take three.
    """
    n, tolerance = matrix.shape[-1], _tolerance(matrix)
    zero = jnp.zeros((), matrix.dtype)
    factor = [[zero] * n for _ in range(n)]
    rows = [[zero] * n for _ in range(n)]
    positive = jnp.asarray(True)
    for j in range(n):
        pivot = matrix[j, j] - sum((factor[j][k] ** 2 for k in range(j)), zero)
        good = pivot > tolerance * jnp.abs(matrix[j, j])
        positive = positive & good
        rows[j][j] = jnp.where(good, jax.lax.rsqrt(jnp.where(good, pivot, 1.0)), 0.0)
        for k in range(j):
            rows[j][k] = -rows[j][j] * total(factor[j][i] * rows[i][k] for i in range(k, j))
        for i in range(j + 1, n):
            rest = matrix[i, j] - sum((factor[i][k] * factor[j][k] for k in range(j)), zero)
            factor[i][j] = jnp.where(good, rest * rows[j][j], 0.0)
    return jnp.stack([jnp.stack(row) for row in rows]), positive


@whitener.defjvp
def _whitener_slope(primals: PyTree, tangents: PyTree) -> tuple[PyTree, PyTree]:
    """dW = -Φ(W dA Wᵀ) W, with rows and columns of zeros where a pivot is zero."""
    white, positive = whitener(*primals)
    slope = -_lower_half(white @ _mirrored(tangents[0]) @ white.T) @ white
    return (white, positive), (slope, np.zeros(positive.shape, jax.dtypes.float0))


def whitener_by_rows(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """The inverse Cholesky factor by a loop over rows, which compiles faster than `whitener`.

    Beyond 8×8 by `cholesky`, and all zero if a pivot is zero.
    """
    n, tolerance = matrix.shape[-1], _tolerance(matrix)
    if n == 0:
        return matrix, jnp.asarray(True)
    if n > _UNROLLED:
        factor, positive = cholesky(matrix)
        return solve_lower(factor, jnp.eye(n, dtype=matrix.dtype)), positive
    every = jnp.arange(n)

    def row(carry: PyTree, j: jax.Array) -> tuple[PyTree, PyTree]:
        rest, ahead = carry
        pivot = rest[j, j]
        good = pivot > tolerance * jnp.abs(matrix[j, j])
        scale = jnp.where(good, jax.lax.rsqrt(jnp.where(good, pivot, 1.0)), 0.0)
        below, own = jnp.where(every > j, rest[:, j] * scale, 0.0), ahead[j] * scale
        return (
            rest - below[:, None] * below[None, :],
            ahead - below[:, None] * own[None, :],
        ), (own, good)

    rows, good = jax.lax.scan(row, (matrix, jnp.eye(n, dtype=matrix.dtype)), every)[1]
    return rows, good.all()


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A⁻¹ of a regular (n, n) matrix: by cofactors up to 3×3, which fuses; by LU beyond."""
    n = matrix.shape[-1]
    a = matrix
    if n == 1:
        return jnp.reciprocal(a)
    if n == 2:
        det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        return jnp.stack([jnp.stack([a[1, 1], -a[0, 1]]), jnp.stack([-a[1, 0], a[0, 0]])]) / det
    if n == 3:
        cofactors = jnp.stack(
            [jnp.cross(a[1], a[2]), jnp.cross(a[2], a[0]), jnp.cross(a[0], a[1])], axis=1
        )
        return cofactors / jnp.dot(a[0], cofactors[:, 0])
    return batched_linalg.inverse(a)


def solve_psd(
    matrix: Float[Array, "n n"], rhs: Float[Array, "n *rest"]
) -> tuple[Float[Array, "n *rest"], Bool[Array, ""]]:
    """A⁻¹ B for a positive definite A (n, n) and B (n, …), and whether A was positive definite."""
    factor, positive = cholesky(matrix)
    reverse = factor[::-1, ::-1].T
    return solve_lower(reverse, solve_lower(factor, rhs)[::-1])[::-1], positive


def inverse_psd(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A⁻¹ of a positive definite A (n, n), exactly symmetric; zero where A is not (n > 8)."""
    return self_gram(whitener_by_rows(matrix)[0])
