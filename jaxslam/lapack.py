"""Factors and solutions beyond the size that is written out: by library, but not in a batch on CPU.

jaxlib's LAPACK kernels divide a batch among the threads of XLA's pool, and wait for them on a
thread of that pool (jaxlib 0.10, `ParallelBatchMap`). Where as many of them run at once as the pool
has threads, all wait for ever: two blocks of a campaign on two cores are enough. Under `vmap` on a
CPU there are hence loops of elementwise code here, which give the same numbers.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp


def _unless_batched_on_cpu(
    library: Callable[..., jax.Array], loop: Callable[..., jax.Array]
) -> Callable[..., jax.Array]:
    """The library's function; under vmap on a CPU the loop."""
    either = jax.custom_batching.custom_vmap(library)

    @either.def_vmap
    def rule(_: int, batched: Any, *arguments: jax.Array) -> tuple[jax.Array, bool]:
        axes = tuple(0 if one else None for one in batched)
        out = jax.lax.platform_dependent(
            *arguments, cpu=jax.vmap(loop, axes), default=jax.vmap(library, axes)
        )
        return out, True

    return either


def _factor_by_columns(matrix: jax.Array) -> jax.Array:
    def column(rest: jax.Array, j: jax.Array) -> tuple[jax.Array, jax.Array]:
        own = jnp.where(jnp.arange(len(rest)) >= j, rest[:, j] / jnp.sqrt(rest[j, j]), 0.0)
        return rest - own[:, None] * own[None, :], own

    return jax.lax.scan(column, matrix, jnp.arange(len(matrix)))[1].T


def _solve_by_rows(factor: jax.Array, rhs: jax.Array) -> jax.Array:
    def row(rest: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        i, column = at
        own = rest[i] / column[i]
        below = jnp.where(jnp.arange(len(rest)) > i, column, 0.0)
        return rest - below[:, None] * own[None, :], own

    return jax.lax.scan(row, rhs, (jnp.arange(len(rhs)), factor.T))[1]


factor = _unless_batched_on_cpu(
    partial(jnp.linalg.cholesky, symmetrize_input=False), _factor_by_columns
)
"""Lower L (n, n) with L Lᵀ = A, NaN where A is not positive definite. Has no derivative."""

_solve = _unless_batched_on_cpu(
    partial(jax.scipy.linalg.solve_triangular, lower=True), _solve_by_rows
)


def solve_lower(factor: jax.Array, rhs: jax.Array) -> jax.Array:
    """L⁻¹ B of a regular lower L (n, n) and B (n, k)."""

    def solve(_: Any, b: jax.Array) -> jax.Array:
        return _solve(factor, b)

    def solve_transposed(_: Any, b: jax.Array) -> jax.Array:
        return _solve(factor[::-1, ::-1].T, b[::-1])[::-1]

    lower = jnp.tril(factor)
    out: jax.Array = jax.lax.custom_linear_solve(
        lambda x: lower @ x, rhs, solve, transpose_solve=solve_transposed
    )
    return out


@jax.custom_jvp
def inverse(matrix: jax.Array) -> jax.Array:
    """A⁻¹ of a regular (n, n) matrix."""
    one = jax.custom_batching.sequential_vmap(lambda matrix: jnp.linalg.inv(matrix))
    return jnp.asarray(one(matrix))


@inverse.defjvp
def _inverse_slope(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    out = inverse(*primals)
    return out, -out @ tangents[0] @ out


def eigenvalues(matrix: jax.Array) -> jax.Array:
    """Of a symmetric (n, n) matrix, ascending (n,). Has no derivative in reverse."""
    one = jax.custom_batching.sequential_vmap(lambda matrix: jnp.linalg.eigvalsh(matrix))
    return jnp.asarray(one(matrix))
