"""The functions of a graph: a factor for each table, and optional robust kernels."""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxslam.core._record import record
from jaxslam.core._reprs import describe
from jaxslam.core.validation import InvalidField, instance_of, require
from jaxslam.graphs._factor import REGISTRY, Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.kernels import Kernel


@record
class Model:
    """Factors and kernels by table."""

    factors: dict[str, Factor]
    """in the order of the names"""
    kernels: dict[str, Kernel]
    """kernels of the tables that have one"""

    @property
    def holds(self) -> bool:
        """Whether the noise of a factor depends on the variables (`Factor.whiten`)."""
        return any(factor.whiten is not None for factor in self.factors.values())


def model_of(
    graph: Graph,
    factors: Mapping[str, Factor] | None,
    kernel: Kernel | Mapping[str, Kernel] | None = None,
) -> Model:
    """The model of a graph's tables. Raises InvalidField as `factors_of`, and on the kernels."""
    by_table = factors_of(graph, factors)
    if kernel is not None and not isinstance(kernel, Mapping):
        kernel = dict.fromkeys(graph.tables, kernel)
    for value in (kernel or {}).values():
        require("kernel", value, instance_of(Kernel, "; graphs.Huber() is one"))
    if lost := sorted(set(kernel or ()) - set(graph.tables)):
        raise InvalidField(
            "kernel",
            f"of tables that are not in the graph: {', '.join(lost)}; there are: "
            f"{', '.join(graph.tables)}",
        )
    return Model(by_table, dict(kernel or {}))


def factors_of(graph: Graph, factors: Mapping[str, Factor] | None) -> dict[str, Factor]:
    """The factor of each table, by its name or by the part of the name before a slash.

    The tables are in the order of their names, as in a graph that has been through `jax.tree.map`.
    By default the factors are `REGISTRY`. Raises InvalidField, also on a factor whose residual has
    another shape than its `errors` tell.
    """
    require("graph", graph, instance_of(Graph, "; datasets.read_graph(path) returns one"))
    by_name = REGISTRY if factors is None else factors
    if not isinstance(by_name, Mapping):
        raise InvalidField("factors", f"expected a dict by table, got {describe(by_name)}")
    for value in by_name.values():
        require("factors", value, instance_of(Factor, "; graphs.RelativePose() is one"))
    by_table = {}
    for key in sorted(graph.tables):
        factor = by_name.get(key, by_name.get(key.split("/")[0]))
        if factor is None:
            raise InvalidField(
                "factors", f"table {key!r} has no factor; there are: {', '.join(by_name) or 'none'}"
            )
        sizes, number = {"pose": 3, "point": np.shape(graph.points)[-1]}, jnp.result_type(float)
        involved = tuple(jax.ShapeDtypeStruct((sizes[kind],), number) for kind in factor.variables)
        z = jax.ShapeDtypeStruct((len(factor.measurements),), number)
        residual = jax.eval_shape(_residual, factor, involved, z)
        got = getattr(residual, "shape", type(residual).__name__)
        if got != (len(factor.errors),):
            raise InvalidField(
                "factors",
                f"the factor {factor.name!r} of table {key!r}: expected a residual of "
                f"shape ({len(factor.errors)},), as its errors tell "
                f"({', '.join(factor.errors)}), got {got}",
            )
        by_table[key] = factor
    if not by_table:
        raise InvalidField("graph", "it has no tables")
    return by_table


@partial(jax.jit, inline=True)
def _residual(factor: Factor, variables: tuple[jax.Array, ...], z: jax.Array) -> PyTree:
    """The residual, jitted: factors of one class share the trace that tells its shape."""
    return factor.residual(variables, z)
