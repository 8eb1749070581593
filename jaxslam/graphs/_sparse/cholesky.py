"""The Cholesky factor of a block-sparse matrix, solutions by it, and blocks of the inverse.

Arrays have the batch B as their last axis: matrices of one pattern share every index, and each
operation runs over contiguous numbers of all of them.
"""

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs._sparse.sweeps import (
    TARGETS,
    Sums,
    Sweep,
    finish,
    index_table,
    level_table,
    no_place,
    pad_targets,
    padded_size,
    padded_table_size,
    places,
    subtract_products,
    sweep,
)
from jaxslam.graphs._sparse.symbolic import Ints, Pattern
from jaxslam.math._linalg import total
from jaxslam.math._xla import where_any


class CholeskyTables(NamedTuple):
    """The tables to factorize, and to solve with, a pattern of n columns and M blocks."""

    factor: Sweep
    diagonal: Int[Array, "n"]
    """the place of each column's diagonal block"""
    pivots: Int[Array, "levels+1"]
    """the first chunk of columns of each level, and the end of the last"""
    pivot_base: Int[Array, "chunks"]
    """the first column of each chunk"""
    forward: Sweep
    forward_order: Int[Array, "n"]
    """the column at each place of the forward substitution"""
    backward: Sweep
    backward_order: Int[Array, "n"]


class Factored(NamedTuple):
    """A Cholesky factor L of n columns."""

    blocks: Float[Array, "places d d B"]
    """`padded_size(M)` and T + 1 more, which are zero beyond the M of the pattern"""
    inverses: Float[Array, "n+T+1 d d B"]
    """L_jj⁻¹; the last is the identity"""
    regular: Bool[Array, "n B"]
    """whether the pivots of a column are positive"""


def cholesky_tables(pattern: Pattern, room: int = 0) -> tuple[CholeskyTables, Ints]:
    """The tables of a pattern, with room for more variables, and the place of each block in
    `Factored.blocks` (M+1,); the last is the place of no block, `no_place`."""
    size, heights, columns, rows = (
        len(pattern.order),
        pattern.heights,
        pattern.columns,
        pattern.rows,
    )
    # L_ik L_jkᵀ is subtracted from the block (i, j), for each two blocks i >= j below a diagonal k.
    target, left, right = [], [], []
    for _, blocks in pattern.below():
        i, j = np.tril_indices(blocks.shape[1])
        left.append(blocks[:, i].ravel())
        right.append(blocks[:, j].ravel())
        target.append(pattern.find(rows[left[-1]], rows[right[-1]]))
    sums = Sums(heights[columns], *map(np.concatenate, (target, left, right)))
    _, place = places(sums, block_count(pattern, room))
    column_place = np.append(np.arange(size), no_place(size))
    factor = sweep(sums, place, place, column_place[np.append(columns, size)], room)
    # Columns are sorted by height: those of a level lie side by side.
    first = np.searchsorted(heights, np.arange(heights[-1] + 2)).tolist()
    chunks = [range(low, high, TARGETS) for low, high in pairwise(first)]
    pivot_base = np.concatenate(chunks)
    below = np.flatnonzero(rows > columns)
    # L y = b from the leaves of the elimination tree to its roots, Lᵀ x = y back.
    downward = Sums(heights, rows[below], below, columns[below])
    upward = Sums(heights[-1] - heights, columns[below], below, rows[below])
    forward_order, forward_place = places(downward, size)
    backward_order, backward_place = places(upward, size)
    return CholeskyTables(
        factor,
        diagonal=index_table(place[pattern.first[:-1]]),
        pivots=level_table(np.cumsum([0, *map(len, chunks)]).tolist(), room),
        pivot_base=index_table(pivot_base, padded_table_size(len(pivot_base), room)),
        forward=sweep(downward, place, forward_place, column_place, room),
        forward_order=index_table(forward_order),
        backward=sweep(upward, place, backward_place, column_place, room),
        backward_order=index_table(backward_order),
    ), place


def block_count(pattern: Pattern, room: int) -> int:
    """The size of the array of a pattern's blocks, with room for more variables.

    With room there are eight a variable at least.
    """
    return padded_size(max(len(pattern.columns), 8 * room))


def by_transposed(a: jax.Array, b: jax.Array) -> jax.Array:
    """A Bᵀ of blocks (T, d, d, B)."""
    return total(a[:, :, None, m] * b[:, None, :, m] for m in range(a.shape[2]))


def by(a: jax.Array, b: jax.Array) -> jax.Array:
    """A B of blocks (T, d, d, B)."""
    return total(a[:, :, m, None] * b[:, None, m] for m in range(a.shape[2]))


def _on_vector(a: jax.Array, x: jax.Array) -> jax.Array:
    """A x of blocks (T, d, d, B) and vectors (T, d, B)."""
    return total(a[:, :, m] * x[:, None, m] for m in range(a.shape[2]))


def _transposed_on_vector(a: jax.Array, x: jax.Array) -> jax.Array:
    """Aᵀ x of blocks (T, d, d, B) and vectors (T, d, B)."""
    return total(a[:, m] * x[:, m, None] for m in range(a.shape[2]))


_SMALL, _UNCERTAIN = 2e-9, 3e-5
"""A pivot below the first share of its entry, and with an error above the second share of itself,
may be rounding of zero. Of poses in a row the least share falls as n⁻², 2e-6 of 3,500 poses, and
the error, as estimated, rises as n³ to 2e-6; of as many poses that may turn together, with one
pivot of rounding, they are 8e-11 or less, and 8e-4 or more."""

_PIVOT_ROUNDING = 32
"""The rounding of a pivot, in eps of the diagonal entry from which products are subtracted."""


def factorize(
    tables: CholeskyTables, blocks: Float[Array, "padded d d B"], uncertain: float = _UNCERTAIN
) -> Factored:
    """The factor of a matrix, from its blocks at their places (lower triangle).

    A pivot that may be rounding of zero, compared with the diagonal entry of the matrix, makes its
    column irregular; its inverse is then taken as zero, so that all numbers stay finite. In float64
    one is irregular, too, that is small and uncertain by the pivots before it (`_roundings`).
    """
    size, width = len(tables.diagonal), blocks.shape[1]
    eps = float(jnp.finfo(blocks.dtype).eps)
    entries = jnp.diagonal(blocks[tables.diagonal], axis1=1, axis2=2)  # (n, B, d)
    entries = jnp.moveaxis(entries, 2, 1)
    # A chunk of TARGETS columns may begin at the last one, hence the rows beyond n. The last
    # inverse is the identity, which leaves a target of no column as it is (`sweeps.no_place`).
    least = jnp.pad(_PIVOT_ROUNDING * eps * entries, [(0, TARGETS), (0, 0), (0, 0)])
    identity = jnp.eye(width, dtype=blocks.dtype)[..., None]
    identity = jnp.broadcast_to(identity, blocks.shape[1:])
    inverses = pad_targets(jnp.zeros((size, *blocks.shape[1:]), blocks.dtype)).at[-1].set(identity)
    regular = jnp.ones((size + TARGETS, blocks.shape[-1]), bool)
    diagonal = jnp.pad(tables.diagonal, (0, TARGETS))

    def level(i: jax.Array, state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        blocks, inverses, regular = state
        blocks = subtract_products(tables.factor, i, blocks, None, None, by_transposed)

        def pivots(c: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            inverses, regular = state
            base = tables.pivot_base[c]
            inverse, positive = _inverse_factor(
                blocks[jax.lax.dynamic_slice_in_dim(diagonal, base, TARGETS)],
                jax.lax.dynamic_slice_in_dim(least, base, TARGETS),
            )
            return (
                jax.lax.dynamic_update_slice_in_dim(inverses, inverse, base, 0),
                jax.lax.dynamic_update_slice_in_dim(regular, positive, base, 0),
            )

        inverses, regular = jax.lax.fori_loop(
            tables.pivots[i], tables.pivots[i + 1], pivots, (inverses, regular)
        )
        return finish(tables.factor, i, blocks, inverses, by_transposed), inverses, regular

    state = jax.lax.fori_loop(
        0, tables.factor.levels, level, (pad_targets(blocks), inverses, regular)
    )
    factored = Factored(state[0], state[1], state[2][:size])
    if _PIVOT_ROUNDING * eps > _SMALL:  # float32: no regular pivot is below _SMALL
        return factored
    root_pivots = 1.0 / jnp.maximum(
        _diagonal(factored.inverses[:size]), jnp.finfo(blocks.dtype).tiny
    )
    small = root_pivots**2 < _SMALL * entries

    def without_uncertain(regular: jax.Array) -> jax.Array:
        lost = small & (eps * _roundings(tables, factored, entries) > uncertain)
        return regular & ~lost.any(axis=1)

    # Nearly every matrix has no small pivot, and then costs no substitution.
    regular = where_any(small.any(), without_uncertain, lambda regular: regular, factored.regular)
    return factored._replace(regular=regular)


def _diagonal(blocks: Float[Array, "n d d B"]) -> Float[Array, "n d B"]:
    """The diagonal of each block."""
    return jnp.stack([blocks[:, r, r] for r in range(blocks.shape[1])], axis=1)


def _roundings(
    tables: CholeskyTables, factored: Factored, entries: Float[Array, "n d B"]
) -> Float[Array, "n d B"]:
    """The rounding error t_j of each pivot p_j = L_jj², in eps of the pivot.

    p_j = a_jj - Σ_k L_jk² has the rounding of a_jj, and L_jk² that of the earlier pivot p_k, by
    which it was divided (as in `linalg.cholesky`):

        t_j = (a_jj + Σ_k L_jk² t_k) / p_j,    k < j

    It is a forward substitution with L_jk² in place of L_jk, whose products are added. Irregular
    columns count as exact, t_j = 0: their L_jj⁻¹ is zero.

    entries: a_jj, the diagonal of the matrix.
    """
    width = entries.shape[1]
    inverse = factored.inverses  # W = L⁻¹ of each diagonal block, lower triangular
    root_inverse = _diagonal(inverse)  # 1/√p
    root = 1.0 / jnp.where(root_inverse > 0, root_inverse, 1.0)
    # L of each diagonal block from W L = I, row by row: L_rc = -L_rr Σ_k W_rk L_kc, c <= k < r.
    factor: list[list[jax.Array]] = []
    for r in range(width):
        row = [
            -root[:, r] * total(inverse[:, r, k] * factor[k][c] for k in range(c, r))
            for c in range(r)
        ]
        factor.append([*row, root[:, r]])
    # What `within` needs of a diagonal block: L_rc² below the diagonal, 1/p_r on it.
    zero = jnp.zeros_like(root[:, 0])
    rows = [
        [*(factor[r][c] ** 2 for c in range(r)), root_inverse[:, r] ** 2, *[zero] * (width - r - 1)]
        for r in range(width)
    ]
    diagonal_squares = jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)
    squares = factored.blocks**2

    def within(sums: jax.Array, block: jax.Array) -> jax.Array:
        """t (T, d, B) of the rows of a block, from a_jj and the terms of earlier blocks."""
        t: list[jax.Array] = []
        for r in range(width):
            terms = (block[:, r, c] * t[c] for c in range(r))
            t.append(total([sums[:, r], *terms]) * block[:, r, r])
        return jnp.stack(t, axis=1)

    def level(i: jax.Array, t: jax.Array) -> jax.Array:
        t = subtract_products(tables.forward, i, t, squares, None, lambda a, t: -_on_vector(a, t))
        return finish(tables.forward, i, t, diagonal_squares, within)

    order = tables.forward_order
    solved = jax.lax.fori_loop(0, tables.forward.levels, level, pad_targets(entries[order]))
    return jnp.zeros_like(entries).at[order].set(solved[: len(order)], unique_indices=True)


def _inverse_factor(
    matrix: Float[Array, "T d d B"], least: Float[Array, "T d B"]
) -> tuple[Float[Array, "T d d B"], Bool[Array, "T B"]]:
    """The inverse factor L⁻¹, as `linalg.whitener`, and whether each pivot is above its least."""
    width = matrix.shape[1]
    zero = jnp.zeros_like(matrix[:, 0, 0])
    factor = [[zero] * width for _ in range(width)]
    inverse = [[zero] * width for _ in range(width)]
    regular = jnp.ones(zero.shape, bool)
    # Column j of L, then row j of L⁻¹ from it.
    for j in range(width):
        pivot = matrix[:, j, j] - total([zero, *(factor[j][k] ** 2 for k in range(j))])
        positive = pivot > least[:, j]
        regular = regular & positive
        # Gradients stay finite: no root of what is not positive.
        root_inverse = jax.lax.rsqrt(jnp.where(positive, pivot, 1.0))
        inverse[j][j] = jnp.where(positive, root_inverse, 0.0)
        for k in range(j):
            inverse[j][k] = -inverse[j][j] * total(
                factor[j][i] * inverse[i][k] for i in range(k, j)
            )
        for i in range(j + 1, width):
            left = matrix[:, i, j] - total([zero, *(factor[i][k] * factor[j][k] for k in range(j))])
            factor[i][j] = left * inverse[j][j]
    return jnp.stack([jnp.stack(row, axis=1) for row in inverse], axis=1), regular


def substitute(
    tables: CholeskyTables, factored: Factored, rhs: Float[Array, "n d B"]
) -> Float[Array, "n d B"]:
    """The solution A⁻¹ b, by columns of the factor."""
    x = rhs
    for direction, order, product in (
        (tables.forward, tables.forward_order, _on_vector),
        (tables.backward, tables.backward_order, _transposed_on_vector),
    ):

        def level(i: jax.Array, x: jax.Array) -> jax.Array:
            x = subtract_products(direction, i, x, factored.blocks, None, product)  # noqa: B023
            return finish(
                direction,  # noqa: B023
                i,
                x,
                factored.inverses,
                lambda x, a: product(a, x),  # noqa: B023
            )

        solved = jax.lax.fori_loop(0, direction.levels, level, pad_targets(x[order]))
        x = jnp.zeros_like(rhs).at[order].set(solved[: len(order)], unique_indices=True)
    return x


class InverseTables(NamedTuple):
    """The tables of the selected inversion of a pattern of n columns and M blocks."""

    sweep: Sweep
    diagonal: Int[Array, "n"]
    """the place of each column's diagonal block"""
    pairs: Int[Array, "Q"]
    """the place of the block of each pair of variables"""
    turned: Bool[Array, "Q"]
    """whether that block has the rows of the second variable and the columns of the first"""


def inverse_tables(
    pattern: Pattern, cholesky_places: Ints, first: Ints, second: Ints, room: int = 0
) -> InverseTables:
    """The tables of a pattern, and of pairs of its variables whose blocks it has.

    cholesky_places: as of `cholesky_tables`.
    """
    size = len(pattern.order)
    sums = _inverse_sums(pattern)
    _, place = places(sums, block_count(pattern, room))
    end = np.append(pattern.columns, no_place(size))
    i, j = pattern.position[first], pattern.position[second]
    pairs = place[pattern.find(np.maximum(i, j), np.minimum(i, j))]
    return InverseTables(
        sweep(sums, place, cholesky_places, end, 2 * room),
        index_table(place[pattern.first[:-1]]),
        index_table(pairs),
        index_table(i < j),
    )


def _inverse_sums(pattern: Pattern) -> Sums:
    """The products Z_ik L_kj of the selected inversion; a large graph has millions."""
    rows, columns = pattern.rows, pattern.columns
    target, left, right, flip = [], [], [], []
    for column, blocks in pattern.below():
        k = rows[blocks]  # (C, m)
        # The rows i of a column, with the diagonal, by the rows k below its diagonal: (C, m+1, m).
        i = np.concatenate([column[:, None], k], axis=1)
        i, k = np.broadcast_arrays(i[:, :, None], k[:, None, :])
        at = np.concatenate([pattern.first[column][:, None], blocks], axis=1, dtype=np.int32)
        target.append(np.broadcast_to(at[:, :, None], i.shape).ravel())
        # Of Z_ik only the lower triangle is stored.
        left.append(pattern.find(np.maximum(i, k).ravel(), np.minimum(i, k).ravel()))
        flip.append((i < k).ravel())
        right.append(np.broadcast_to(blocks[:, None, :], i.shape).ravel())
    depth = pattern.heights[-1] - pattern.heights
    # The diagonal block of a column comes after the blocks below it, which it sums.
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
    inverses = jnp.swapaxes(factored.inverses[:size], 1, 2)
    # δ_ij L_jjᵀ⁻¹
    start = jnp.zeros((count, *inverses.shape[1:]), inverses.dtype)
    start = start.at[tables.diagonal].set(inverses)

    def level(i: jax.Array, blocks: jax.Array) -> jax.Array:
        blocks = subtract_products(tables.sweep, i, blocks, None, factored.blocks, by)
        return finish(tables.sweep, i, blocks, factored.inverses, by)

    inverse: jax.Array = jax.lax.fori_loop(0, tables.sweep.levels, level, start)
    return inverse
