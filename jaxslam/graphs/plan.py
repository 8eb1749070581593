"""The plan of a graph: which variables its measurements join, and the tables to solve it."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Int

from jaxslam.graphs.factor import Factor, of_files
from jaxslam.graphs.graph import Graph
from jaxslam.graphs.sparse.cholesky import CholeskyTables, cholesky_tables
from jaxslam.graphs.sparse.gathered import Stages, stages
from jaxslam.graphs.sparse.sweeps import table
from jaxslam.graphs.sparse.symbolic import factor_pattern
from jaxslam.validation.numbers import is_concrete


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
    """from blocks (row, one variable, other variable) of all tables to those of the matrix"""
    gradient: Stages
    """from (row, variable) of all tables to columns"""
    block_column: Int[Array, "M"]
    block_row: Int[Array, "M"]
    on_diagonal: Bool[Array, "M"]
    cholesky: CholeskyTables


def plan(graph: Graph, factors: Mapping[str, Factor] | None = None) -> Plan:
    """The plan of a graph, made on the host from `who`, which must be concrete.

    Give it to `optimize` to solve many graphs of one pattern, under `vmap` or one by one:

        plan = graphs.plan(graph)
        jax.vmap(lambda g: graphs.optimize(g, plan=plan))(many)

    Rows that are not valid are in the pattern all the same: which are may differ from graph to
    graph.

    Raises:
        ValueError: where `who` is traced, or the tables do not fit their factors.
    """
    factors = factors_of("graphs.plan", graph, factors)
    poses, points = len(graph.poses), len(graph.points)
    size = poses + points
    who, rows = {}, []
    for name, its in graph.tables.items():
        if not is_concrete(its.who):
            raise ValueError(
                f"graphs.plan: `who` of the table {name!r} is traced: make the plan of one graph "
                "outside, and give it as `plan`"
            )
        who[name] = np.asarray(its.who, np.int32)
        count = np.array([poses if kind == "pose" else points for kind in factors[name].variables])
        lost = ((who[name] < 0) | (who[name] >= count)).any(axis=1)
        bad = lost & np.asarray(its.valid) if is_concrete(its.valid) else lost
        who[name] = np.where(lost[:, None], 0, who[name])
        if bad.any():
            raise ValueError(
                f"graphs.plan: row {bad.argmax()} of the table {name!r} is of a variable that is "
                f"nowhere: {np.asarray(its.who)[bad.argmax()].tolist()}"
            )
        shift = np.array([poses * (kind == "point") for kind in factors[name].variables])
        rows.append(who[name] + shift)
    pairs = [
        np.stack([r[:, a], r[:, b]]) for r in rows for a in range(r.shape[1]) for b in range(a)
    ]
    first, second = np.concatenate([np.zeros((2, 0), int), *pairs], axis=1)
    pattern = factor_pattern(size, first, second)
    cholesky, order = cholesky_tables(pattern)
    place = np.argsort(order)
    columns = [pattern.position[r] for r in rows]
    blocks = []
    for column in columns:
        one, other = np.broadcast_arrays(column[:, :, None], column[:, None, :])
        lower = one >= other
        target = np.full(one.shape, -1)
        target[lower] = place[pattern.find(one[lower], other[lower])]
        blocks.append(target.ravel())
    block_column, block_row = pattern.columns[order], pattern.rows[order]
    return Plan(
        who={name: table(rows) for name, rows in who.items()},
        order=table(pattern.order),
        column=table(pattern.position),
        information=stages(np.concatenate(blocks), len(order)),
        gradient=stages(np.concatenate([column.ravel() for column in columns]), size),
        block_column=table(block_column),
        block_row=table(block_row),
        on_diagonal=table(block_row == block_column),
        cholesky=cholesky,
    )


def factors_of(name: str, graph: Graph, factors: Mapping[str, Factor] | None) -> dict[str, Factor]:
    """The factor of each table: of the same name, or of the part before a slash.

    Without factors they are those of files. Raises ValueError, which begins with a caller's name.
    """
    known = of_files() if factors is None else factors
    out = {}
    for key in graph.tables:
        found = known.get(key, known.get(key.split("/")[0]))
        if found is None:
            raise ValueError(
                f"{name}: table {key!r} has no factor; there are: {', '.join(known) or 'none'}"
            )
        out[key] = found
    if not out:
        raise ValueError(f"{name}: the graph has no tables")
    return out


def plan_for(name: str, graph: Graph, factors: Mapping[str, Factor], given: Plan | None) -> Plan:
    """The given plan, checked against the graph as far as that is concrete, or a new one."""
    if given is None:
        return plan(graph, factors)
    size = len(graph.poses) + len(graph.points)
    same = given.order.shape == (size,) and set(given.who) == set(graph.tables)
    for key, who in given.who.items():
        same = same and np.shape(graph.tables[key].who) == np.shape(who)
        if same and is_concrete(graph.tables[key].who) and is_concrete(who):
            same = bool(np.array_equal(graph.tables[key].who, who))
    if not same:
        raise ValueError(f"{name}: the plan is of another graph: variables or `who` differ")
    return given
