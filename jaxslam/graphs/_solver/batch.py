"""Programs that many graphs share: of one pattern in a batch, or padded to sizes that recur.

A program is compiled for the sizes of its arrays. Those of a graph are the numbers of poses, points
and rows, which differ from log to log and from round to round of loop closing.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PyTree

from jaxslam.core._numbers import is_concrete
from jaxslam.core.types import JaxOrNumPy
from jaxslam.graphs._graph import Graph, Table
from jaxslam.graphs._sparse.sweeps import padded_size
from jaxslam.math._arrays import in_dtype

_T = TypeVar("_T")

LEAST = 16
"""The step of the sizes of small graphs."""


def padded_graph(graph: Graph, room: int = 0) -> Graph:
    """The graph with more poses and points, which are fixed, and rows, which are not valid.

    With room for n variables there are n poses, and two rows a pose.

    For concrete graphs: its arrays are NumPy's. The rows have variable -1, which is out of range,
    so that a plan leaves them out.
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


_GROUP = 16
"""Graphs of a batch that are computed together; groups follow each other. 256 of 434 poses at once
are a tenth as fast on a CPU, since their arrays leave its caches, and all wait for the slowest."""
Array = jax.Array


def with_batch(tree: _T) -> _T:
    """The arrays with a last axis of one graph."""
    return cast(_T, jax.tree.map(lambda x: jnp.asarray(x)[..., None], tree))


def over_batch(name: str, function: Callable[..., _T]) -> Callable[[PyTree, PyTree], _T]:
    """The function of one graph, called with (shared, graph), from a function of graphs with a last
    axis B.

    `function(*shared, graphs)` computes all graphs at once, so that its loops run over tables that
    the graphs share. Under `vmap`, nested or not, the batch becomes larger. Raises ValueError,
    which begins with a caller's name, if a shared argument has a batch axis.
    """

    @jax.custom_batching.custom_vmap
    def whole(shared: PyTree, graphs: PyTree) -> _T:
        return function(*shared, graphs)

    @whole.def_vmap
    def rule(size: int, batched: PyTree, shared: PyTree, graphs: PyTree) -> tuple[_T, PyTree]:
        if any(jax.tree.leaves(batched[0])):
            raise ValueError(
                f"{name}: expected the same factors, kernels, plan and limits for all graphs "
                "of a batch"
            )

        if size > _GROUP:
            groups = -(-size // _GROUP)
            rows = np.arange(groups * _GROUP) % size  # the last group is filled up with the first

            def parted(x: Array, one: bool) -> Array:
                x = x if one else jnp.broadcast_to(x[None], (size, *x.shape))
                return x[rows].reshape(groups, _GROUP, *x.shape[1:])

            together = jax.vmap(lambda group: whole(shared, group))
            out = jax.lax.map(together, jax.tree.map(parted, graphs, batched[1]))
            out = jax.tree.map(lambda x: x.reshape(groups * _GROUP, *x.shape[2:])[:size], out)
            return out, jax.tree.map(lambda _: True, out)

        def fold(x: Array, one: bool) -> Array:
            wide = jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], size, x.shape[-1]))
            x = jnp.moveaxis(x, 0, -2) if one else wide
            return x.reshape(*x.shape[:-2], size * x.shape[-1])

        def unfold(x: Array) -> Array:
            return jnp.moveaxis(x.reshape(*x.shape[:-1], size, x.shape[-1] // size), -2, 0)

        out = jax.tree.map(unfold, whole(shared, jax.tree.map(fold, graphs, batched[1])))
        return out, jax.tree.map(lambda _: True, out)

    def single(shared: PyTree, graphs: PyTree) -> _T:
        return cast(_T, jax.tree.map(lambda x: x[..., 0], whole(shared, with_batch(graphs))))

    return single


def graph_in_one_dtype(graph: Graph) -> Graph:
    """The graph with its numbers in one precision, the highest of them; whole numbers become real
    ones."""
    numbers = [graph.poses, graph.points]
    numbers += [x for table in graph.tables.values() for x in (table.z, table.information)]
    dtype = jnp.result_type(*numbers, float)

    def real(x: JaxOrNumPy) -> JaxOrNumPy:
        return x if jnp.issubdtype(x.dtype, jnp.floating) else jnp.asarray(x, dtype)

    tables = {
        key: table._replace(z=real(table.z), information=real(table.information))
        for key, table in graph.tables.items()
    }
    graph = graph._replace(poses=real(graph.poses), points=real(graph.points), tables=tables)
    return in_dtype(graph, dtype)
