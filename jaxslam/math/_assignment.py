"""A traceable solver of the linear assignment problem: distinct columns at least total cost."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array


class _Matching(NamedTuple):
    """The assignment of the rows so far, with the dual variables that prove it least."""

    by_row: Array
    """(m,) the dual variable of each row"""
    by_column: Array
    """(n,) the dual variable of each column"""
    column_of: Array
    """(m,) column of each row, -1 where not yet assigned"""
    row_of: Array
    """(n,) row of each column, -1 where free"""


def assign(cost: Array) -> Array:
    """The column (m,) of each row, all different, that minimizes Σ cost[i, column_i]; m <= n.

    Shortest augmenting paths with dual variables, O(m²·n): Jonker & Volgenant 1987, for rectangles
    as in Crouse, "On implementing 2D rectangular assignment algorithms", IEEE T-AES 52(4), 2016.

    Args:
        cost: (m, n), finite.
    Raises:
        ValueError: if m > n.
    """
    m, n = cost.shape
    if m > n:
        raise ValueError(f"assign: expected at least as many columns as rows, got {cost.shape}")
    if m == 0:
        return jnp.zeros(0, jnp.int32)
    # Columns are integers, which have no derivative by the cost.
    cost = jax.lax.stop_gradient(cost)
    unassigned, dual = jnp.full(n, -1, jnp.int32), jnp.zeros(n, cost.dtype)

    def add_row(matching: _Matching, row: Array) -> tuple[_Matching, None]:
        path = _shortest_path(cost, matching, row)
        # The duals that keep every reduced cost at or above zero.
        in_tree = path.rows.at[row].set(False)
        at_column = path.length[jnp.maximum(matching.column_of, 0)]
        by_row = matching.by_row + jnp.where(in_tree, path.least - at_column, 0.0)
        by_row = by_row.at[row].add(path.least)
        shorter = jnp.where(path.columns, path.least - path.length, 0.0)
        column_of, row_of = _augment(matching, path, row)
        return _Matching(by_row, matching.by_column - shorter, column_of, row_of), None

    start = _Matching(dual[:m], dual, unassigned[:m], unassigned)
    return jax.lax.scan(add_row, start, jnp.arange(m, dtype=jnp.int32))[0].column_of


class _Path(NamedTuple):
    """The tree of shortest paths from one row, as far as Dijkstra's algorithm has grown it."""

    row: Array
    """() the row from which the search continues"""
    least: Array
    """() length of the path to that row"""
    length: Array
    """(n,) length of the shortest path to each column"""
    before: Array
    """(n,) the row before each column on its path"""
    rows: Array
    """(m,) bool: rows in the tree"""
    columns: Array
    """(n,) bool: columns in the tree"""
    free: Array
    """() the free column that ends the search, -1 before that"""


def _shortest_path(cost: Array, matching: _Matching, row: Array) -> _Path:
    """The shortest path from a row to a free column, by Dijkstra's algorithm on reduced costs."""
    m, n = cost.shape
    start = _Path(
        row=row,
        least=jnp.zeros((), cost.dtype),
        length=jnp.full(n, jnp.inf, cost.dtype),
        before=jnp.full(n, -1, jnp.int32),
        rows=jnp.zeros(m, bool),
        columns=jnp.zeros(n, bool),
        free=jnp.full((), -1, jnp.int32),
    )

    def grow(path: _Path) -> _Path:
        through = path.least + cost[path.row] - matching.by_row[path.row] - matching.by_column
        shorter = ~path.columns & (through < path.length)
        length = jnp.where(shorter, through, path.length)
        column = jnp.argmin(jnp.where(path.columns, jnp.inf, length)).astype(jnp.int32)
        owner = matching.row_of[column]
        return _Path(
            row=jnp.maximum(owner, 0),
            least=length[column],
            length=length,
            before=jnp.where(shorter, path.row, path.before),
            rows=path.rows.at[path.row].set(True),
            columns=path.columns.at[column].set(True),
            free=jnp.where(owner < 0, column, -1),
        )

    return jax.lax.while_loop(lambda path: path.free < 0, grow, start)


def _augment(matching: _Matching, path: _Path, row: Array) -> tuple[Array, Array]:
    """The matching updated along the augmenting path, from its free column back to the row."""

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        column, column_of, row_of = state
        owner = path.before[column]
        before = column_of[owner]
        matched = owner == row
        return (
            jnp.where(matched, -1, before),
            column_of.at[owner].set(column),
            row_of.at[column].set(owner),
        )

    start = path.free, matching.column_of, matching.row_of
    return jax.lax.while_loop(lambda state: state[0] >= 0, step, start)[1:]
