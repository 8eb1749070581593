"""The squared residuals of a graph, row by row."""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.core.numbers import is_concrete
from jaxslam.graphs.factor import Factor
from jaxslam.graphs.graph import Graph
from jaxslam.graphs.solver.model import factors_of
from jaxslam.graphs.solver.padding import cut, padded_graph


def squared_residuals(
    graph: Graph, factors: Mapping[str, Factor] | None = None, *, room: int = 0
) -> dict[str, Float[Array, "E"]]:
    """The squared residual eᵀ Ω e of every row of every table, 0 where not valid; their sum is χ².

    Of a row with R residuals, at the truth and with the right Ω, it is χ² distributed with R
    degrees of freedom. factors, room: as for `optimize`.
    """
    factors = factors_of("graphs.squared_residuals", graph, factors)
    found = _squared(factors, padded_graph(graph, room) if is_concrete(graph) else graph)
    return {key: cut(square, graph.tables[key].valid) for key, square in found.items()}


def degrees_of_freedom(graph: Graph, factors: Mapping[str, Factor] | None = None) -> int:
    """The residuals of all valid rows minus the free numbers of poses and points."""
    factors = factors_of("graphs.degrees_of_freedom", graph, factors)
    residuals = sum(
        int(table.valid.sum()) * len(factors[key].errors) for key, table in graph.tables.items()
    )
    free = 3 * int((~graph.fixed_pose).sum())
    return residuals - free - graph.points.shape[1] * int((~graph.fixed_point).sum())


@partial(jax.jit, inline=True)
def _squared(factors: dict[str, Factor], graph: Graph) -> dict[str, Float[Array, "E"]]:
    found = {}
    for key, factor in factors.items():
        table = graph.tables[key]

        def square(who: Array, z: Array, information: Array, factor: Factor = factor) -> Array:
            values = tuple(
                (graph.poses if kind == "pose" else graph.points)[who[k]]
                for k, kind in enumerate(factor.variables)
            )
            e = factor.residual(values, z)
            return e @ information @ e

        who, z, information = (jnp.asarray(part) for part in table[:3])
        found[key] = jnp.where(table.valid, jax.vmap(square)(who, z, information), 0.0)
    return found
