"""The data of a graph: variables, and measurements between them in tables by kind.

The cost of a graph is χ² = Σ eᵀ Ω e over all valid rows of all tables, without a factor ½: e is the
residual of the row (`Factor`) and Ω its information. `datasets.read_graph` and `write_graph` are
for its files.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.core._reprs import short_repr
from jaxslam.core.types import JaxOrNumPy

LOOPS = "relative_pose/loops"
"""The key of a separate table of loop edges, which can have a robust kernel."""

TRUSTED = ("relative_pose", "prior")
"""Tables without a robust kernel where loops are doubted: odometry and priors."""


class Table(NamedTuple):
    """Measurements of one kind, E rows: K variables, Z numbers measured and R residuals each."""

    who: Int[JaxOrNumPy, "E K"]
    """the variables of a row: indices of poses or points, as the factor's `variables` says"""
    z: Float[JaxOrNumPy, "E Z"]
    """the measurement"""
    information: Float[JaxOrNumPy, "E R R"]
    """Ω, the inverse of the residual's covariance; symmetric, positive semidefinite"""
    valid: Bool[JaxOrNumPy, "E"]
    """False for padding, and for rows that are left out"""

    def __repr__(self) -> str:
        return short_repr(self)


class Graph(NamedTuple):
    """A graph of N poses and P points (or landmarks of L numbers); leading axes by `vmap`.

    The factor of a table is in a separate dictionary with the same keys, because data hold no
    functions: `graphs.REGISTRY` has the factors of files.
    """

    poses: Float[JaxOrNumPy, "N 3"]
    """(x, y, θ); a computed θ is wrapped, and one from a file is unchanged"""
    points: Float[JaxOrNumPy, "P L"]
    tables: dict[str, Table]
    fixed_pose: Bool[JaxOrNumPy, "N"]
    """poses that optimization does not move"""
    fixed_point: Bool[JaxOrNumPy, "P"]
    pose_id: Int[JaxOrNumPy, "N"]
    """identity in a file, or in a log the number of controls before it"""
    point_id: Int[JaxOrNumPy, "P"]
    """identity in a file, or tag in a log"""

    def __repr__(self) -> str:
        return short_repr(self)


def ranks(graph: Graph) -> Int[np.ndarray, "N"]:
    """The place of each pose in the order of the ids."""
    return np.argsort(np.argsort(np.asarray(graph.pose_id), kind="stable"))


def is_successive(graph: Graph, who: Int[JaxOrNumPy, "E 2"]) -> Bool[np.ndarray, "E"]:
    """Whether each row joins poses that follow each other in the order of the ids: odometry."""
    first, second = ranks(graph)[np.asarray(who)].reshape(-1, 2).T
    return np.asarray(np.abs(second - first) == 1)


def with_loops_apart(graph: Graph) -> Graph:
    """The graph with its loop edges in the table "relative_pose/loops".

    Loop edges are the rows of `relative_pose` between poses that do not follow each other in the
    order of the ids; odometry stays. The order of poses and rows has no influence.
    `graphs.optimize(graph, kernel={"relative_pose/loops": graphs.Cauchy()})` then doubts the loops
    alone. Concrete graphs only; a table without rows is left out. A graph that has a table of loops
    is returned as it is.
    """
    if LOOPS in graph.tables:
        return graph
    tables: dict[str, Table] = {}
    for key, table in graph.tables.items():
        if key != "relative_pose":
            tables[key] = table
            continue
        along = is_successive(graph, table.who)
        for name, rows in ((key, along), (LOOPS, ~along)):
            if rows.any():
                tables[name] = Table(*(part[rows] for part in table))
    return graph._replace(tables=tables)
