"""The data of a graph: variables, and measurements between them in tables by kind; its files.

The cost of a graph is χ² = Σ eᵀ Ω e over all valid rows of all tables, without a factor ½: e is the
residual of the row (`Factor`) and Ω its information. `read` and `write` are the public names
of what `datasets._g2o` does.
"""

from pathlib import Path
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
    """false for padding, and for rows that are left out"""

    def __repr__(self) -> str:
        return short_repr(self)


class Graph(NamedTuple):
    """A graph of N poses and P points (or landmarks of L numbers); leading axes by `vmap`.

    The factor of a table is in a separate dictionary with the same keys, because data hold
    no functions: `graphs.REGISTRY` has those of files.
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


def successive(graph: Graph, who: Int[JaxOrNumPy, "E 2"]) -> Bool[np.ndarray, "E"]:
    """Which rows join poses that follow each other in the order of the ids: the odometry."""
    first, second = ranks(graph)[np.asarray(who)].reshape(-1, 2).T
    return np.asarray(np.abs(second - first) == 1)


def with_loops_apart(graph: Graph) -> Graph:
    """The graph with its loop edges in the table "relative_pose/loops".

    They are the rows of `relative_pose` between poses that do not follow each other in the order of
    the ids; those of the odometry stay. The order of poses and rows has no influence.
    `graphs.optimize(graph, kernel={"relative_pose/loops": graphs.Cauchy()})`
    then doubts the loops alone. Concrete graphs only; a table without rows is left out. A graph
    that has a table of loops is returned as it is.
    """
    if LOOPS in graph.tables:
        return graph
    tables: dict[str, Table] = {}
    for key, table in graph.tables.items():
        if key != "relative_pose":
            tables[key] = table
            continue
        along = successive(graph, table.who)
        for name, rows in ((key, along), (LOOPS, ~along)):
            if rows.any():
                tables[name] = Table(*(part[rows] for part in table))
    return graph._replace(tables=tables)


def read(path: str | Path) -> Graph:
    """The graph in a file of g2o or TORO, packed by gzip or not; arrays are NumPy's, of float64.

    The lines, their fields, and where they are in the graph:

        VERTEX_SE2           id x y θ                                  poses
        VERTEX2, VERTEX      id x y θ                                  poses (TORO)
        VERTEX_XY            id x y                                    points
        FIX                  ids                                       fixed_pose, fixed_point
        EDGE_SE2             i j x y θ I11 I12 I13 I22 I23 I33         relative_pose
        EDGE2, EDGE          a b f s r I_ff I_fs I_ss I_rr I_fr I_sr   relative_pose (TORO)
        EDGE_PRIOR_SE2       i x y θ, and Ω as EDGE_SE2 has it         prior
        EDGE_SE2_XY          i l x y I11 I12 I22                       relative_position
        EDGE_BEARING_SE2_XY  i l bearing I11                           bearing

    Poses and points are in the order of the file; the last five name tables. A line `EQUIV i j` of
    TORO makes two vertices one: that of the smaller id stays with its pose and has the edges of
    both, but for edges between them, which are left out.
    Numbers are those of the file. Comments (`#`), scans (`ROBOTLASER1`), notes (`VERTEX_TAG`,
    `VERTEX_ELLIPSE`) and offsets of sensors (`PARAMS_SE2OFFSET`, to which no edge that is read
    refers) are skipped; the command `jaxslam optimize` counts them. In a file without vertices,
    poses and points have the order of their ids and are placed along the edges, `starts.odometry`.
    The cost of the graph is χ² = Σ eᵀ Ω e, with e from `graphs.REGISTRY` and without a factor ½.

    Kümmerle et al. 2011, "g2o: A general framework for graph optimization", ICRA; Grisetti et al.
    2007, "A tree parameterization for efficiently computing maximum likelihood maps using gradient
    descent", RSS (TORO).

    Raises:
        ValueError: `path:line: reason` for an unknown or malformed line, a vertex that occurs
            twice, an edge to a missing vertex or from one to itself, an information that is not
            positive semidefinite, and equal vertices that are missing, or a pose and a point.
    """
    from jaxslam.datasets import _g2o as g2o

    return g2o.load(path).graph


def write(path: str | Path, graph: Graph) -> None:
    """Write a graph as a file that `read` reads as the same graph, number by number.

    The format is g2o; in a file that ends in .toro or .graph it is TORO, which has lines for poses
    and relative poses. A file that ends in .gz, after that, is packed by gzip.

    Poses, points, the tables in their order, then `FIX`, at which GTSAM's reader stops. Rows that
    are not valid are left out. A table "name/part" is written as the table "name", and read as
    part of it.

    Raises ValueError, before anything is written, on data without a line in the format: in TORO
    points, fixed poses, and tables other than relative poses; in g2o tables that `read` does not
    name and points of other than two numbers. In both on an id of both a pose and a point, and on
    what `read` refuses: ids twice or below zero, numbers that are not finite, and informations that
    are not symmetric and positive semidefinite.
    """
    from jaxslam.datasets import _g2o as g2o

    g2o.save(path, graph)
