"""Graphs in a batch: how a function of one graph runs over many of one pattern."""

from collections.abc import Callable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxslam.graphs.graph import Graph
from jaxslam.math.arrays import in_dtype
from jaxslam.types import JaxOrNumPy

_T = TypeVar("_T")

GROUP = 16
"""Graphs of a batch that are computed together; groups follow each other. 256 of 434 poses at once
are a tenth as fast on a CPU, since their arrays leave its caches, and all wait for the slowest."""
Array = jax.Array


def with_batch(tree: _T) -> _T:
    """The arrays with a last axis of one graph."""
    return cast(_T, jax.tree.map(lambda x: jnp.asarray(x)[..., None], tree))


def over_batch(name: str, function: Callable[..., _T]) -> Callable[[PyTree, PyTree], _T]:
    """The function of one graph (shared, own), from one of graphs with a last axis B.

    `function(*shared, own)` computes all graphs at once, so that its loops run over tables that the
    graphs share. Under `vmap`, nested or not, the batch becomes larger. Raises ValueError, which
    begins with a caller's name, where what is shared has a batch of its own.
    """

    @jax.custom_batching.custom_vmap
    def whole(shared: PyTree, own: PyTree) -> _T:
        return function(*shared, own)

    @whole.def_vmap
    def rule(size: int, batched: PyTree, shared: PyTree, own: PyTree) -> tuple[_T, PyTree]:
        if any(jax.tree.leaves(batched[0])):
            raise ValueError(
                f"{name}: expected one model, one plan and one set of limits for a batch"
            )

        if size > GROUP:
            groups = -(-size // GROUP)
            rows = np.arange(groups * GROUP) % size  # the last group is filled up with the first

            def parted(x: Array, one: bool) -> Array:
                x = x if one else jnp.broadcast_to(x[None], (size, *x.shape))
                return x[rows].reshape(groups, GROUP, *x.shape[1:])

            together = jax.vmap(lambda own: whole(shared, own))
            out = jax.lax.map(together, jax.tree.map(parted, own, batched[1]))
            out = jax.tree.map(lambda x: x.reshape(groups * GROUP, *x.shape[2:])[:size], out)
            return out, jax.tree.map(lambda _: True, out)

        def fold(x: Array, one: bool) -> Array:
            wide = jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], size, x.shape[-1]))
            x = jnp.moveaxis(x, 0, -2) if one else wide
            return x.reshape(*x.shape[:-2], size * x.shape[-1])

        def unfold(x: Array) -> Array:
            return jnp.moveaxis(x.reshape(*x.shape[:-1], size, x.shape[-1] // size), -2, 0)

        out = jax.tree.map(unfold, whole(shared, jax.tree.map(fold, own, batched[1])))
        return out, jax.tree.map(lambda _: True, out)

    def single(shared: PyTree, own: PyTree) -> _T:
        return cast(_T, jax.tree.map(lambda x: x[..., 0], whole(shared, with_batch(own))))

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
