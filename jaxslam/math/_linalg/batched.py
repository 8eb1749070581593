"""Linear algebra of matrices too large to unroll: library calls, in a loop on a CPU.

jaxlib's LAPACK kernels divide a batch among the threads of XLA's pool, and wait for them on a
thread of that pool (jaxlib 0.10, `ParallelBatchMap`). If as many kernels run at once as the pool
has threads, they deadlock; two blocks of a campaign on two cores are enough. So under `vmap` on a
CPU the calls run in a loop, one matrix each.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import PyTree


def _one_by_one_on_cpu(library: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """The function, which under vmap on a CPU runs as a loop over the batch."""
    either = jax.custom_batching.custom_vmap(library)

    @either.def_vmap
    def rule(size: int, batched: PyTree, *arguments: jax.Array) -> tuple[jax.Array, bool]:
        axes = tuple(0 if has_batch else None for has_batch in batched)

        def loop(*arguments: jax.Array) -> jax.Array:
            stacks = tuple(
                array if has_batch else jnp.broadcast_to(array[None], (size, *array.shape))
                for array, has_batch in zip(arguments, batched, strict=True)
            )
            out: jax.Array = jax.lax.map(lambda rows: either(*rows), stacks)
            return out

        out = jax.lax.platform_dependent(*arguments, cpu=loop, default=jax.vmap(library, axes))
        return out, True

    return either


factor = _one_by_one_on_cpu(partial(jnp.linalg.cholesky, symmetrize_input=False))
"""Lower L (n, n) with L Lᵀ = A, NaN where A is not positive definite. No derivative."""

_solve = _one_by_one_on_cpu(partial(jax.scipy.linalg.solve_triangular, lower=True))


def solve_lower(factor: jax.Array, rhs: jax.Array) -> jax.Array:
    """The solution L⁻¹ B of a regular lower L (n, n) and B (n, k)."""

    def solve(_: PyTree, b: jax.Array) -> jax.Array:
        return _solve(factor, b)

    def solve_transposed(_: PyTree, b: jax.Array) -> jax.Array:
        return _solve(factor[::-1, ::-1].T, b[::-1])[::-1]

    lower = jnp.tril(factor)
    out: jax.Array = jax.lax.custom_linear_solve(
        lambda x: lower @ x, rhs, solve, transpose_solve=solve_transposed
    )
    return out


@jax.custom_jvp
def inverse(matrix: jax.Array) -> jax.Array:
    """The inverse of a regular (n, n) matrix."""
    library = jax.custom_batching.sequential_vmap(lambda matrix: jnp.linalg.inv(matrix))
    return jnp.asarray(library(matrix))


@inverse.defjvp
def _inverse_slope(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
    out = inverse(*primals)
    return out, -out @ tangents[0] @ out
