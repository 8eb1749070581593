"""The plan of a graph: which variables its measurements join, and the tables to solve it."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Int
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.graphs._factor import Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.model import factors_of
from jaxslam.graphs._sparse.cholesky import (
    CholeskyTables,
    InverseTables,
    block_count,
    cholesky_tables,
    inverse_tables,
)
from jaxslam.graphs._sparse.sweeps import Stages, index_table, stages
from jaxslam.graphs._sparse.symbolic import factor_pattern


class Plan(NamedTuple):
    """The symbolic part of a graph's solution, for n variables: N poses, then P points.

    It depends on the numbers of variables and on `who` of each table, and serves all graphs that
    have these in common.
    """

    who: dict[str, Int[Array, "_ _"]]
    order: Int[Array, "n"]
    """the variable of each column of the matrix"""
    column: Int[Array, "n"]
    """the column of each variable"""
    information: Stages
    """sums of blocks (row, variable, variable) of all tables to the blocks of the matrix"""
    gradient: Stages
    """sums of vectors (row, variable) of all tables to columns"""
    block_column: Int[Array, "padded"]
    """column of each of the M blocks of the factor; rows beyond M are of no block
    (`sweeps.padded_size`)"""
    block_row: Int[Array, "padded"]
    on_diagonal: Bool[Array, "padded"]
    cholesky: CholeskyTables
    inverse: InverseTables | None
    """None without `marginals`"""
    pairs: Int[Array, "Q 2"]


def plan(
    graph: Graph,
    factors: Mapping[str, Factor] | None = None,
    *,
    marginals: bool = False,
    pairs: ArrayLike = (),
    room: int = 0,
) -> Plan:
    """The plan of a graph, made on the host from `who`, which must be concrete.

    Give it to `optimize` to solve many graphs of one pattern, under `vmap` or one by one:

        plan = graphs.plan(graph)
        jax.vmap(lambda g: graphs.optimize(g, plan=plan))(many)

    Rows that are not valid are in the pattern as well, since another graph may have other valid
    rows; rows of a variable out of range, as -1, are not.

    Args:
        graph: only its `who` and the numbers of poses and points are read.
        factors: as in `optimize`.
        marginals: whether to plan `marginals` as well.
        pairs: (Q, 2), two variables each, points counted on from the poses, of which `marginals`
            shall give the joint covariance.
        room: the number of variables for which tables have room, so that graphs of fewer share a
            compiled program.
    Raises:
        ValueError: where `who` is traced, or the tables do not fit their factors.
    """
    who, rows = {}, []
    with refusals_of("graphs.plan"):
        factors = factors_of(graph, factors)
        poses, points = len(graph.poses), len(graph.points)
        size = poses + points
        wanted = checked_pairs(pairs, size)
        for name in factors:
            table = graph.tables[name]
            if not is_concrete(table.who):
                raise InvalidField(
                    "",
                    f"`who` of the table {name!r} is traced: make the plan of one graph "
                    "outside, and give it as `plan`",
                )
            who[name] = np.asarray(table.who, np.int32)
            count = np.array(
                [poses if kind == "pose" else points for kind in factors[name].variables]
            )
            lost = ((who[name] < 0) | (who[name] >= count)).any(axis=1)
            bad = lost & np.asarray(table.valid) if is_concrete(table.valid) else lost
            if bad.any():
                raise InvalidField(
                    "",
                    f"row {bad.argmax()} of the table {name!r} has a variable out of "
                    f"range: {np.asarray(table.who)[bad.argmax()].tolist()}",
                )
            who[name] = np.where(lost[:, None], 0, who[name])
            shift = np.array([poses * (kind == "point") for kind in factors[name].variables])
            rows.append((who[name] + shift, lost))
    # Each two variables of a row have a block, and so have the pairs of `marginals`.
    joined = [
        np.stack([variables[~lost, k], variables[~lost, j]])
        for variables, lost in rows
        for k in range(variables.shape[1])
        for j in range(k)
    ]
    first, second = np.concatenate([wanted.T, *joined], axis=1)
    pattern = factor_pattern(size, first, second)
    cholesky, place = cholesky_tables(pattern, room)
    order = np.argsort(place[:-1])
    blocks, columns = [], []
    for variables, lost in rows:
        column = pattern.position[variables]
        # The block of each two variables (rows, K, K), of the lower triangle; -1 drops a row's.
        i, j = np.broadcast_arrays(column[:, :, None], column[:, None, :])
        lower = (i >= j) & ~lost[:, None, None]
        target = np.full(i.shape, -1)
        target[lower] = place[pattern.find(i[lower], j[lower])]
        blocks.append(target.ravel())
        columns.append(np.where(lost[:, None], -1, column).ravel())
    block_column, block_row = pattern.columns[order], pattern.rows[order]
    width = block_count(pattern, room)
    return Plan(
        who={name: index_table(rows) for name, rows in who.items()},
        order=index_table(pattern.order),
        column=index_table(pattern.position),
        # With room for two rows of two variables a pose: eight blocks, and four gradients.
        information=stages(np.concatenate(blocks), width, 8 * room),
        gradient=stages(np.concatenate(columns), size, 4 * room),
        block_column=index_table(block_column, width),
        block_row=index_table(block_row, width),
        on_diagonal=index_table(block_row == block_column, width),
        cholesky=cholesky,
        inverse=inverse_tables(pattern, place, wanted[:, 0], wanted[:, 1], room)
        if marginals
        else None,
        pairs=index_table(wanted),
    )


def checked_pairs(pairs: ArrayLike, size: int) -> Int[np.ndarray, "Q 2"]:
    """Pairs of variables, (Q, 2); raises InvalidField on another shape, on numbers that are not
    whole, and on one out of range."""
    numbers = np.asarray(pairs)
    if numbers.size == 0:
        return np.zeros((0, 2), int)
    if numbers.ndim != 2 or numbers.shape[1] != 2 or not np.issubdtype(numbers.dtype, np.integer):
        got = f"{numbers.dtype} of shape {numbers.shape}"
        raise InvalidField("pairs", f"expected whole numbers, (Q, 2), got {got}")
    wanted = numbers.astype(int)
    if ((wanted < 0) | (wanted >= size)).any():
        raise InvalidField(
            "pairs", f"expected variables from 0 to {size - 1}, got {wanted.tolist()}"
        )
    return wanted


def plan_for(
    graph: Graph,
    factors: Mapping[str, Factor],
    existing: Plan | None,
    *,
    marginals: bool = False,
    pairs: Int[np.ndarray, "Q 2"] | None = None,
    room: int = 0,
) -> Plan:
    """The existing plan, checked against the graph as far as that is concrete, or a new one."""
    if existing is None:
        wanted = () if pairs is None else pairs
        return plan(graph, factors, marginals=marginals, pairs=wanted, room=room)
    size = len(graph.poses) + len(graph.points)
    same = existing.order.shape == (size,) and set(existing.who) == set(graph.tables)
    for key, who in existing.who.items():
        same = same and np.shape(graph.tables[key].who) == np.shape(who)
        if same and is_concrete(graph.tables[key].who) and is_concrete(who):
            same = bool(np.array_equal(graph.tables[key].who, who))
    if not same:
        raise InvalidField("plan", "it is of another graph: variables or `who` differ")
    if marginals and existing.inverse is None:
        raise InvalidField("plan", "it is without marginals: `plan(graph, marginals=True)`")
    if (
        pairs is not None
        and len(pairs)
        and not (is_concrete(existing.pairs) and np.array_equal(existing.pairs, pairs))
    ):
        raise InvalidField("plan", "it is of other pairs: `plan(graph, pairs=…)`")
    return existing
