"""Graphs padded to sizes that recur, so that graphs of about one size share their programs.

A program is compiled for the sizes of its arrays. Those of a graph are the numbers of poses, points
and rows, which differ from log to log and from round to round of loop closing.
"""

from typing import TypeVar, cast

import jax
import numpy as np
from jaxtyping import Int, PyTree

from jaxslam import programs
from jaxslam.graphs.graph import Graph, Table
from jaxslam.graphs.sparse.sweeps import padded_size

_T = TypeVar("_T")

LEAST = 16
"""The step of the sizes of small graphs."""


def padded_graph(graph: Graph) -> Graph:
    """The graph with more poses and points, which are fixed, and rows, which are not valid.

    For concrete graphs: its arrays are NumPy's. The rows are of variable -1, which is nowhere, so
    that a plan leaves them out.
    """

    def more(x: PyTree, value: float = 0) -> np.ndarray:
        x = np.asarray(x)
        rows = [(0, padded_size(len(x), LEAST) - len(x))] + [(0, 0)] * (x.ndim - 1)
        return np.pad(x, rows, constant_values=value)

    return Graph(
        poses=more(graph.poses),
        points=more(graph.points),
        tables={
            name: Table(more(t.who, -1), more(t.z), more(t.information), more(t.valid, False))
            for name, t in graph.tables.items()
        },
        fixed_pose=more(graph.fixed_pose, True),
        fixed_point=more(graph.fixed_point, True),
        pose_id=more(graph.pose_id, -1),
        point_id=more(graph.point_id, -1),
    )


def padded_number(
    variables: Int[np.ndarray, "*shape"], graph: Graph, more: Graph
) -> Int[np.ndarray, "*shape"]:
    """The numbers in the padded graph of a graph's variables, points counted on from the poses."""
    shift = len(more.poses) - len(graph.poses)
    return np.where(variables >= len(graph.poses), variables + shift, variables)


def own_number(variable: jax.Array, graph: Graph, more: Graph) -> jax.Array:
    """The number of a variable in the graph, by that in the padded one."""
    count, number = len(more.poses), np.asarray(variable)
    return programs.on_device(number - (count - len(graph.poses)) * (number >= count))


def cut(found: _T, like: PyTree) -> _T:
    """The arrays without the rows that are beyond those of others."""

    def one(x: jax.Array, other: PyTree) -> jax.Array:
        # By NumPy: a slice on the device is a program for each size.
        return x if len(x) == len(other) else programs.on_device(np.asarray(x)[: len(other)])

    return cast(_T, jax.tree.map(one, found, like))
