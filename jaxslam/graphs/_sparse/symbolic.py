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
    """The variables in a minimum-degree order, for a graph with edges between first and second.

    SuperLU's multiple minimum degree (Liu 1985, "Modification of the minimum-degree algorithm by
    multiple elimination", ACM TOMS 11(2)) on the pattern of A + Aᵀ. SciPy gives it only with a
    factorization, here of a diagonally dominant matrix with one number a block.
    """
    links = scipy.sparse.coo_matrix((-np.ones(len(first)), (first, second)), (size, size))
    links = links + links.T
    dominant = scipy.sparse.diags_array(1.0 + np.asarray(abs(links).sum(axis=0)).ravel()) + links
    options = {"SymmetricMode": True}
    # With a threshold of 0 each pivot is on the diagonal: the order is that of the pattern.
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
    """height of each column, (n,), ascending"""
    rows: Ints
    columns: Ints
    """row and column of each block (B,), rows >= columns; sorted by column, then row"""

    @cached_property
    def position(self) -> Ints:
        """The column of each variable, (n,)."""
        column = np.empty(len(self.order), int)
        column[self.order] = np.arange(len(self.order))
        return column

    @cached_property
    def first(self) -> Ints:
        """The first block of each column, its diagonal one, (n+1,); the last is B."""
        first: Ints = np.searchsorted(self.columns, np.arange(len(self.order) + 1))
        return first

    def find(self, rows: Ints, columns: Ints) -> Ints:
        """The blocks at rows and columns; raises ValueError where there is none."""
        size = len(self.order)
        # A number for each block, ascending since the blocks are sorted by column, then row.
        keys = self.columns * size + self.rows
        wanted = columns * size + rows
        blocks: Ints = np.searchsorted(keys, wanted).astype(np.int32)  # half the memory
        if len(wanted) and (blocks.max() >= len(keys) or (keys[blocks] != wanted).any()):
            raise ValueError("graphs: a block is not in the pattern of the plan")
        return blocks

    def below(self) -> list[tuple[Ints, Ints]]:
        """The columns with m blocks below the diagonal, (C,), and these blocks, (C, m), for each
        m."""
        counts = np.diff(self.first) - 1
        groups = []
        for m in np.unique(counts):
            columns = np.flatnonzero(counts == m)
            blocks = self.first[columns][:, None] + 1 + np.arange(m)
            groups.append((columns, blocks.astype(np.int32)))
        return groups


def factor_pattern(size: int, first: Ints, second: Ints) -> Pattern:
    """The pattern of L for an A with blocks on the diagonal and between first and second.

    The rows below the diagonal of a column are those of A and of the columns whose parent it is in
    the elimination tree (Davis 2006, "Direct methods for sparse linear systems", chapter 4).
    """
    order = _minimum_degree(size, first, second)
    position = np.empty(size, int)
    position[order] = np.arange(size)
    low, high = np.sort([position[first], position[second]], axis=0)
    below: list[set[int]] = [set() for _ in range(size)]
    for column, row in zip(low.tolist(), high.tolist(), strict=True):
        if column != row:
            below[column].add(row)
    # The parent of a column is its first row below the diagonal; it inherits the other rows.
    height = [0] * size
    for column, rows_below in enumerate(below):
        if rows_below:
            parent = min(rows_below)
            below[parent] |= rows_below
            below[parent].discard(parent)
            height[parent] = max(height[parent], height[column] + 1)
    heights = np.array(height)
    # A parent is higher than its children, so this is an order of elimination of the same fill.
    by_height = np.argsort(heights, kind="stable")
    column_of = np.empty(size, int)
    column_of[by_height] = np.arange(size)
    counts = [len(rows_below) for rows_below in below]
    diagonal = np.arange(size)
    under = np.fromiter(itertools.chain.from_iterable(below), int, sum(counts))
    columns = column_of[np.concatenate([diagonal, np.repeat(diagonal, counts)])]
    rows = column_of[np.concatenate([diagonal, under])]
    blocks = np.lexsort((rows, columns))
    return Pattern(order[by_height], heights[by_height], rows[blocks], columns[blocks])
