"""The plan of a graph: which variables its measurements join, and the tables to solve it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Int

from jaxslam.graphs.graph import Graph
from jaxslam.graphs.sparse.cholesky import CholeskyTables, cholesky_tables
from jaxslam.graphs.sparse.gathered import Stages, stages
from jaxslam.graphs.sparse.symbolic import factor_pattern
from jaxslam.validation.numbers import is_concrete


class Plan(NamedTuple):
    """The symbolic part of a graph's solution, for n = N + P variables: poses, then points.

    It depends on the numbers of variables and on `who` of each table, and serves all graphs that
    have these in common.
    """

    who: dict[str, Int[Array, "E K"]]
    order: Int[Array, "n"]
    """the variable of each column of the matrix"""
    column: Int[Array, "n"]
    """the column of each variable"""
    information: Stages
    """from the blocks of all rows of all tables (E K K) to those of the matrix"""
    gradient: Stages
    """from the variables of all rows of all tables (E K) to columns"""
    block_column: Int[Array, "M"]
    on_diagonal: Bool[Array, "M"]
    cholesky: CholeskyTables


def plan(graph: Graph, *, caller: str = "plan") -> Plan:
    """The plan of a graph, made on the host from `who`, which must be concrete.

    Give it to `optimize` to solve many graphs of one pattern, under `vmap` or one by one:

        plan = graphs.plan(graph)
        jax.vmap(lambda g: graphs.optimize(g, plan=plan))(many)

    Raises:
        ValueError: where `who` is traced or batched, or points at a variable that is nowhere.
    """
    size = graph.poses.shape[-2] + graph.points.shape[-2]
    who = {}
    for name, table in graph.tables.items():
        if not is_concrete(table.who):
            raise ValueError(
                f"{caller}: `who` of the table {name!r} is traced: make the plan outside, "
                "with `graphs.plan`, and give it as `plan`"
            )
        rows = np.asarray(table.who)
        if rows.ndim != 2:
            raise ValueError(
                f"{caller}: expected `who` of the table {name!r} of shape (E, K), got {rows.shape}"
            )
        who[name] = rows.astype(np.int32)
    return _planned(graph, who, size, caller)


def _planned(graph: Graph, who: dict[str, np.ndarray], size: int, caller: str) -> Plan:
    raise NotImplementedError
