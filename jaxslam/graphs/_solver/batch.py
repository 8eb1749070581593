"""Programs that many graphs share: of one pattern in a batch, or padded to sizes that recur.

A program is compiled for the sizes of its arrays: of a graph the numbers of poses, points and rows,
which differ from log to log and from round to round of loop closing.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PyTree

from jaxslam.core._numbers import is_concrete
from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import InvalidField
from jaxslam.graphs._graph import Graph, Table
from jaxslam.graphs._sparse.sweeps import padded_size
from jaxslam.math._arrays import in_dtype

_T = TypeVar("_T")

LEAST = 16
"""The step of the sizes of small graphs."""


def padded_graph(graph: Graph, room: int = 0) -> Graph:
    """The graph with further poses and points, which are fixed, and rows, which are not valid.

    With room for n variables there are n poses, and two rows a pose.

    For concrete graphs: its arrays are NumPy's. The rows have variable -1, which is out of range,
    so that a plan leaves them out.
    """

    def pad(x: PyTree, value: float = 0, least: int = 0) -> np.ndarray:
        x = np.asarray(x)
        rows = [(0, padded_size(max(len(x), least), LEAST) - len(x))] + [(0, 0)] * (x.ndim - 1)
        return np.pad(x, rows, constant_values=value)

    return Graph(
        poses=pad(graph.poses, 0, room),
        points=pad(graph.points),
        tables={
            name: Table(
                pad(table.who, -1, 2 * room),
                pad(table.z, 0, 2 * room),
                pad(table.information, 0, 2 * room),
                pad(table.valid, False, 2 * room),
            )
            for name, table in graph.tables.items()
        },
        fixed_pose=pad(graph.fixed_pose, True, room),
        fixed_point=pad(graph.fixed_point, True),
        pose_id=pad(graph.pose_id, -1, room),
        point_id=pad(graph.point_id, -1),
    )


def padded_number(
    variables: Int[np.ndarray, "*shape"], graph: Graph, padded: Graph
) -> Int[np.ndarray, "*shape"]:
    """The numbers in the padded graph of a graph's variables, points counted on from the poses."""
    shift = len(padded.poses) - len(graph.poses)
    return np.where(variables >= len(graph.poses), variables + shift, variables)


def original_number(variable: jax.Array, graph: Graph, padded: Graph) -> jax.Array:
    """The number in the graph of a variable of the padded graph."""
    count, shift = len(padded.poses), len(padded.poses) - len(graph.poses)
    return _by_numpy(
        lambda number: number - shift * (number >= count).astype(number.dtype), variable
    )


def cut(arrays: _T, like: PyTree) -> _T:
    """The arrays, each cut to as many rows as the array in its place has in `like`."""

    def cut_rows(x: jax.Array, example: PyTree) -> jax.Array:
        return x if len(x) == len(example) else _by_numpy(lambda x: x[: len(example)], x)

    return cast(_T, jax.tree.map(cut_rows, arrays, like))


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


def over_batch(function: Callable[..., _T]) -> Callable[[PyTree, PyTree], _T]:
    """The function of one graph, called with (shared, graph), from a function of graphs with a last
    axis B.

    `function(*shared, graphs)` computes all graphs at once, so that its loops run over tables that
    the graphs share. Under `vmap`, nested or not, the batch becomes larger. Raises InvalidField if
    a shared argument has a batch axis.
    """

    @jax.custom_batching.custom_vmap
    def batched_call(shared: PyTree, graphs: PyTree) -> _T:
        return function(*shared, graphs)

    @batched_call.def_vmap
    def rule(size: int, batched: PyTree, shared: PyTree, graphs: PyTree) -> tuple[_T, PyTree]:
        if any(jax.tree.leaves(batched[0])):
            raise InvalidField(
                "graphs", "expected the same factors, kernels, plan and limits for all of a batch"
            )

        if size > _GROUP:
            groups = -(-size // _GROUP)
            rows = np.arange(groups * _GROUP) % size  # the last group is filled up with the first

            def to_groups(x: Array, is_batched: bool) -> Array:
                x = x if is_batched else jnp.broadcast_to(x[None], (size, *x.shape))
                return x[rows].reshape(groups, _GROUP, *x.shape[1:])

            together = jax.vmap(lambda group: batched_call(shared, group))
            results = jax.lax.map(together, jax.tree.map(to_groups, graphs, batched[1]))
            results = jax.tree.map(
                lambda x: x.reshape(groups * _GROUP, *x.shape[2:])[:size], results
            )
            return results, jax.tree.map(lambda _: True, results)

        # The new axis, of `size`, is first; it is folded into the last, (size, …, B) to
        # (…, size B), and the results are unfolded.
        def fold(x: Array, is_batched: bool) -> Array:
            wide = jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], size, x.shape[-1]))
            x = jnp.moveaxis(x, 0, -2) if is_batched else wide
            return x.reshape(*x.shape[:-2], size * x.shape[-1])

        def unfold(x: Array) -> Array:
            return jnp.moveaxis(x.reshape(*x.shape[:-1], size, x.shape[-1] // size), -2, 0)

        folded = jax.tree.map(fold, graphs, batched[1])
        results = jax.tree.map(unfold, batched_call(shared, folded))
        return results, jax.tree.map(lambda _: True, results)

    def single_call(shared: PyTree, graphs: PyTree) -> _T:
        result = batched_call(shared, with_batch(graphs))
        return cast(_T, jax.tree.map(lambda x: x[..., 0], result))

    return single_call


def graph_in_one_dtype(graph: Graph) -> Graph:
    """The graph with its numbers in one precision, the highest among them; integers become
    floats."""
    numbers = [graph.poses, graph.points]
    numbers += [x for table in graph.tables.values() for x in (table.z, table.information)]
    dtype = jnp.result_type(*numbers, float)

    def as_float(x: JaxOrNumPy) -> JaxOrNumPy:
        return x if jnp.issubdtype(x.dtype, jnp.floating) else jnp.asarray(x, dtype)

    tables = {
        key: table._replace(z=as_float(table.z), information=as_float(table.information))
        for key, table in graph.tables.items()
    }
    graph = graph._replace(
        poses=as_float(graph.poses), points=as_float(graph.points), tables=tables
    )
    return in_dtype(graph, dtype)
