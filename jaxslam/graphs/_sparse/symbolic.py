"""Symbolic factorization: the blocks of the Cholesky factor and the products that make them.

All of it is NumPy on the host, done once for a pattern of variables and measurements. The order of
elimination is one that keeps the factor sparse.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Int


def _minimum_degree(
    size: int, first: Int[np.ndarray, "E"], second: Int[np.ndarray, "E"]
) -> Int[np.ndarray, "size"]:
    """The variables in a minimum-degree order, for a graph with edges first-second.

    SuperLU's multiple minimum degree (Liu 1985, "Modification of the minimum-degree algorithm by
    multiple elimination", ACM TOMS 11(2)) on the pattern of A + Aᵀ. SciPy gives it only with a
    factorization, here of a diagonally dominant matrix with one number a block.
    """
    links = scipy.sparse.coo_matrix((-np.ones(len(first)), (first, second)), (size, size))
    links = links + links.T
    dominant = scipy.sparse.diags_array(1.0 + np.asarray(abs(links).sum(axis=0)).ravel()) + links
    options = {"SymmetricMode": True}
    factors = scipy.sparse.linalg.splu(
        dominant.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return np.argsort(factors.perm_c)


Ints = Int[np.ndarray, "_"]


@dataclass(frozen=True, eq=False)
class Pattern:
    """The blocks of the factor L of a symmetric matrix A = L Lᵀ of n×n blocks.

    Columns are numbered in the order of elimination, which is sorted by the height of a column in
    the elimination tree: columns of one height do not depend on each other.
    """

    order: Ints
    """the variable of each column, (n,)"""
    heights: Ints
    """(n,), of the columns, ascending"""
    rows: Ints
    columns: Ints
    """of each block (B,), rows >= columns; sorted by column, then row"""

    @cached_property
    def position(self) -> Ints:
        """The column of each variable, (n,)."""
        out = np.empty(len(self.order), int)
        out[self.order] = np.arange(len(self.order))
        return out

    @cached_property
    def first(self) -> Ints:
        """The first block of each column, its diagonal one, (n+1,); the last is B."""
        out: Ints = np.searchsorted(self.columns, np.arange(len(self.order) + 1))
        return out

    def find(self, rows: Ints, columns: Ints) -> Ints:
        """The blocks at these places, which must exist."""
        size = len(self.order)
        keys = self.columns * size + self.rows
        wanted = columns * size + rows
        found: Ints = np.searchsorted(keys, wanted).astype(np.int32)  # half the memory
        if len(wanted) and (found.max() >= len(keys) or (keys[found] != wanted).any()):
            raise ValueError("graphs: a block is not in the pattern of the plan")
        return found

    def below(self) -> list[tuple[Ints, Ints]]:
        """For each number m of blocks below a diagonal: the columns that have m, (C,), and those
        blocks, (C, m)."""
        counts = np.diff(self.first) - 1
        out = []
        for m in np.unique(counts):
            columns = np.flatnonzero(counts == m)
            blocks = self.first[columns][:, None] + 1 + np.arange(m)
            out.append((columns, blocks.astype(np.int32)))
        return out


def factor_pattern(size: int, first: Ints, second: Ints) -> Pattern:
    """The pattern of L for an A with blocks on the diagonal and at first-second.

    The rows below the diagonal of a column are those of A and of the columns whose parent it is in
    the elimination tree (Davis 2006, "Direct methods for sparse linear systems", chapter 4).
    """
    order = _minimum_degree(size, first, second)
    position = np.empty(size, int)
    position[order] = np.arange(size)
    one, other = position[first], position[second]
    below: list[set[int]] = [set() for _ in range(size)]
    for low, high in zip(
        np.minimum(one, other).tolist(), np.maximum(one, other).tolist(), strict=True
    ):
        if low != high:
            below[low].add(high)
    height = [0] * size
    for column, under_it in enumerate(below):
        if under_it:
            parent = min(under_it)
            below[parent] |= under_it
            below[parent].discard(parent)
            height[parent] = max(height[parent], height[column] + 1)
    heights = np.array(height)
    # A parent is higher than its children, so this is an order of elimination of the same fill.
    again = np.argsort(heights, kind="stable")
    column_of = np.empty(size, int)
    column_of[again] = np.arange(size)
    counts = [len(rows) for rows in below]
    every = np.arange(size)
    under = np.fromiter(itertools.chain.from_iterable(below), int, sum(counts))
    columns = column_of[np.concatenate([every, np.repeat(every, counts)])]
    rows = column_of[np.concatenate([every, under])]
    blocks = np.lexsort((rows, columns))
    return Pattern(order[again], heights[again], rows[blocks], columns[blocks])
