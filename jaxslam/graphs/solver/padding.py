"""Graphs padded to sizes that recur, so that graphs of about one size share their programs.

A program is compiled for the sizes of its arrays. Those of a graph are the numbers of poses, points
and rows, which differ from log to log and from round to round of loop closing.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import jax
import numpy as np
from jaxtyping import Int, PyTree

from jaxslam.core.numbers import is_concrete
from jaxslam.graphs.graph import Graph, Table
from jaxslam.graphs.sparse.sweeps import padded_size

_T = TypeVar("_T")

LEAST = 16
"""The step of the sizes of small graphs."""


def padded_graph(graph: Graph, room: int = 0) -> Graph:
    """The graph with more poses and points, which are fixed, and rows, which are not valid.

    With room for so many variables there are as many poses, and two rows a pose.

    For concrete graphs: its arrays are NumPy's. The rows are of variable -1, which is nowhere, so
    that a plan leaves them out.
    """

    def more(x: PyTree, value: float = 0, least: int = 0) -> np.ndarray:
        x = np.asarray(x)
        rows = [(0, padded_size(max(len(x), least), LEAST) - len(x))] + [(0, 0)] * (x.ndim - 1)
        return np.pad(x, rows, constant_values=value)

    return Graph(
        poses=more(graph.poses, 0, room),
        points=more(graph.points),
        tables={
            name: Table(
                more(t.who, -1, 2 * room),
                more(t.z, 0, 2 * room),
                more(t.information, 0, 2 * room),
                more(t.valid, False, 2 * room),
            )
            for name, t in graph.tables.items()
        },
        fixed_pose=more(graph.fixed_pose, True, room),
        fixed_point=more(graph.fixed_point, True),
        pose_id=more(graph.pose_id, -1, room),
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
    count, shift = len(more.poses), len(more.poses) - len(graph.poses)
    return _by_numpy(lambda number: number - shift * (number >= count), variable)


def cut(found: _T, like: PyTree) -> _T:
    """The arrays without the rows that are beyond those of others."""

    def one(x: jax.Array, other: PyTree) -> jax.Array:
        return x if len(x) == len(other) else _by_numpy(lambda x: x[: len(other)], x)

    return cast(_T, jax.tree.map(one, found, like))


def _by_numpy(change: Callable[[PyTree], PyTree], x: jax.Array) -> jax.Array:
    """The changed array, by NumPy unless it is traced: on the device each size is a program."""
    return cast(
        jax.Array,
        jax.device_put(np.array(change(np.asarray(x)))) if is_concrete(x) else change(x),
    )
