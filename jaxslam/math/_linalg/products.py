"""Sums and products of a filter's small matrices, which fuse into one pass over the result."""

import functools
import operator
from collections.abc import Callable, Iterable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

_T = TypeVar("_T")

# Up to this many rows a product AᵀB is written as outer products, which XLA fuses into one pass
# over the result; beyond, as one matrix product.
_OUTER_PRODUCTS = 16


def total(terms: Iterable[jax.Array]) -> jax.Array:
    """The sum of at least one array, unrolled, so that it fuses into one elementwise kernel."""
    return functools.reduce(operator.add, terms)


def rematerialize(function: Callable[..., _T]) -> Callable[..., _T]:
    """The function, rematerialized in reverse mode: only its arguments are stored.

    Unrolled code would otherwise store one array of the whole loop for each entry.
    """
    # Within a scan or a batch XLA does not merge the recomputation with the original.
    return jax.checkpoint(function, prevent_cse=False)


def gram(a: Float[Array, "k D"], b: Float[Array, "k E"]) -> Float[Array, "D E"]:
    """The product Aᵀ B of A (k, D), B (k, E), for small k."""
    if a.shape[0] > _OUTER_PRODUCTS or a.shape[0] == 0:
        # Not a.T @ b, for which a gradient would store a transposed copy of A.
        return jax.lax.dot_general(a, b, (((0,), (0,)), ((), ())))
    return _outer_products(a, b)


@rematerialize
def _outer_products(a: Float[Array, "k D"], b: Float[Array, "k E"]) -> Float[Array, "D E"]:
    return total(a[k, :, None] * b[k, None, :] for k in range(a.shape[0]))


@jax.custom_jvp
def self_gram(a: Float[Array, "k D"]) -> Float[Array, "D D"]:
    """The product Aᵀ A of A (k, D) for any k; one product in a gradient, where `gram` takes two."""
    return gram(a, a)


@self_gram.defjvp
def _square_slope(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
    half = gram(tangents[0], primals[0])
    return self_gram(*primals), half + half.T


def gram_both(a: Float[Array, "k D"], b: Float[Array, "k D"]) -> Float[Array, "D D"]:
    """The sum Aᵀ B + Bᵀ A of A, B (k, D), for small k; symmetric to the bit."""
    return gram(a, b) + gram(b, a)


def matmul(a: Float[Array, "n k"], b: Float[Array, "k D"]) -> Float[Array, "n D"]:
    """The product A B of A (n, k), B (k, D), for small k."""
    return gram(a.T, b)


def symmetrize(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """The symmetric part (A + Aᵀ)/2 over the last two axes."""
    return 0.5 * (matrix + jnp.swapaxes(matrix, -1, -2))
