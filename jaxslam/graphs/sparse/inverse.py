"""Blocks of the inverse of a block-sparse matrix, from its Cholesky factor."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs.sparse.cholesky import Factored, block_count, by
from jaxslam.graphs.sparse.sweeps import (
    Sums,
    Sweep,
    finish,
    index_table,
    nothing,
    places,
    subtract_products,
    sweep,
)
from jaxslam.graphs.sparse.symbolic import Ints, Pattern


class InverseTables(NamedTuple):
    """What the selected inversion of a pattern of n columns and M blocks needs."""

    sweep: Sweep
    diagonal: Int[Array, "n"]
    """the place of each column's diagonal block"""
    pairs: Int[Array, "Q"]
    """the place of the block of each pair of variables"""
    turned: Bool[Array, "Q"]
    """whether that block is of the second variable's rows and the first one's columns"""


def inverse_tables(
    pattern: Pattern, cholesky_places: Ints, first: Ints, second: Ints, room: int = 0
) -> InverseTables:
    """The tables of a pattern, and of pairs of its variables whose blocks it has.

    cholesky_places: of each block in `Factored.blocks`, and of none.
    """
    size = len(pattern.order)
    sums = _sums(pattern)
    _, place = places(sums, block_count(pattern, room))
    end = np.append(pattern.columns, nothing(size))
    one, other = pattern.position[first], pattern.position[second]
    pairs = place[pattern.find(np.maximum(one, other), np.minimum(one, other))]
    return InverseTables(
        sweep(sums, place, cholesky_places, end, 2 * room),
        index_table(place[pattern.first[:-1]]),
        index_table(pairs),
        index_table(one < other),
    )


def _sums(pattern: Pattern) -> Sums:
    """The products of the selected inversion, of which a large graph has millions."""
    rows, columns = pattern.rows, pattern.columns
    target, left, right, flip = [], [], [], []
    for column, blocks in pattern.below():
        own = rows[blocks]  # (C, m)
        # The rows of a column, its own included, by the rows below its diagonal.
        every = np.concatenate([column[:, None], own], axis=1)
        one, other = np.broadcast_arrays(every[:, :, None], own[:, None, :])
        at = np.concatenate([pattern.first[column][:, None], blocks], axis=1, dtype=np.int32)
        target.append(np.broadcast_to(at[:, :, None], one.shape).ravel())
        left.append(pattern.find(np.maximum(one, other).ravel(), np.minimum(one, other).ravel()))
        flip.append((one < other).ravel())
        right.append(np.broadcast_to(blocks[:, None, :], one.shape).ravel())
    depth = pattern.heights[-1] - pattern.heights
    # The diagonal block of a column comes after those below it, of which it is a sum.
    level = 2 * depth[columns] + (rows == columns)
    return Sums(level, *map(np.concatenate, (target, left, right, flip)))


def selected_inverse(tables: InverseTables, factored: Factored) -> Float[Array, "places d d B"]:
    """The blocks of A⁻¹ where L has blocks.

        Z_ij = (δ_ij L_jjᵀ⁻¹ - Σ_k Z_ik L_kj) L_jj⁻¹, k the rows of L below the diagonal of column j

    from the last column to the first (Takahashi, Fagan and Chin 1973; Erisman and Tinney 1975, "On
    computing certain elements of the inverse of a sparse matrix", Comm. ACM 18(3)).
    """
    size = len(tables.diagonal)
    count = len(factored.blocks)
    own = jnp.swapaxes(factored.inverses[:size], 1, 2)
    start = jnp.zeros((count, *own.shape[1:]), own.dtype).at[tables.diagonal].set(own)

    def level(i: jax.Array, blocks: jax.Array) -> jax.Array:
        blocks = subtract_products(tables.sweep, i, blocks, None, factored.blocks, by)
        return finish(tables.sweep, i, blocks, factored.inverses, by)

    out: jax.Array = jax.lax.fori_loop(0, tables.sweep.levels, level, start)
    return out
