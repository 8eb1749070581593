"""Graphs in files: the public names of what `datasets.g2o` reads and writes."""

from pathlib import Path

from jaxslam.graphs.graph import Graph


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

    Poses and points are in the order of the file; the last five name tables.
    Numbers are those of the file. Comments (`#`), scans (`ROBOTLASER1`), notes (`VERTEX_TAG`,
    `VERTEX_ELLIPSE`) and offsets of sensors (`PARAMS_SE2OFFSET`, to which no edge that is read
    refers) are skipped; `datasets.g2o.load` counts them. In a file without vertices, poses
    and points have the order of their ids and are placed along the edges, `starts.odometry`. The
    cost of what is read is χ² = Σ eᵀ Ω e, with e as `graphs.REGISTRY` has it and no factor ½.

    Kümmerle et al. 2011, "g2o: A general framework for graph optimization", ICRA; Grisetti et al.
    2007, "A tree parameterization for efficiently computing maximum likelihood maps using gradient
    descent", RSS (TORO).

    Raises:
        ValueError: `path:line: reason` for an unknown or malformed line, a vertex that occurs
            twice, an edge to a vertex that is nowhere or from one to itself, and an information
            that is not positive semidefinite.
    """
    from jaxslam.datasets import g2o

    return g2o.load(path).graph


def write(path: str | Path, graph: Graph) -> None:
    """Write a graph as a file that `read` reads as the same graph, number by number.

    The format is g2o; in a file that ends in .toro or .graph it is TORO, which has lines for poses
    and relative poses alone. A file that ends in .gz, after that, is packed by gzip.

    Poses, points, the tables in their order, then `FIX`, at which GTSAM's reader stops. Rows that
    are not valid are left out. A table "name/part" is written as the table "name", and read as
    part of it.

    Raises ValueError, before anything is written, on what the format has no line for: in TORO
    points, fixed poses, and tables other than relative poses; in g2o tables that `read` does not
    name and points of other than two numbers. In both on an id of both a pose and a point, and on
    what `read` refuses: ids twice or below zero, numbers that are not finite, and informations that
    are not symmetric and positive semidefinite.
    """
    from jaxslam.datasets import g2o

    g2o.save(path, graph)
