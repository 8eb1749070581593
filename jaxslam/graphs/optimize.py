"""The optimum of a graph: Gauss-Newton and Levenberg-Marquardt on sparse blocks."""

import functools
from collections.abc import Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam import programs
from jaxslam.graphs.factor import Factor
from jaxslam.graphs.graph import Graph
from jaxslam.graphs.kernels import Kernel
from jaxslam.graphs.linearized import (
    Model,
    cost,
    data_of,
    variables_of,
)
from jaxslam.graphs.plan import Plan, factors_of, plan_for
from jaxslam.graphs.search import METHODS, Solution, minimize
from jaxslam.graphs.validation import check_graph
from jaxslam.validation.numbers import check_count


@functools.lru_cache(maxsize=256)
def model_of(
    factors: tuple[tuple[str, Factor], ...], kernels: tuple[tuple[str, Kernel], ...]
) -> Model:
    """The model of these functions, one object for the same ones."""
    return Model(factors, kernels)


def kernels_of(
    name: str, graph: Graph, kernel: Kernel | Mapping[str, Kernel] | None
) -> dict[str, Kernel]:
    """The kernel of each table that has one. Raises ValueError beginning with a caller's name."""
    if kernel is None:
        return {}
    if isinstance(kernel, Kernel):
        return dict.fromkeys(graph.tables, kernel)
    if lost := sorted(set(kernel) - set(graph.tables)):
        raise ValueError(
            f"{name}: kernels of tables that are not in the graph: {', '.join(lost)}; "
            f"there are: {', '.join(graph.tables)}"
        )
    return dict(kernel)


def optimize(
    graph: Graph,
    factors: Mapping[str, Factor] | None = None,
    *,
    method: str = "levenberg_marquardt",
    kernel: Kernel | Mapping[str, Kernel] | None = None,
    iterations: int = 100,
    tolerance: float = 1e-12,
    plan: Plan | None = None,
) -> Solution:
    """The graph at a minimum of χ² = Σ ρ(eᵀ Ω e), from the variables it has.

    Each step solves (H + λD) δ = -g with H = Σ Jᵀ ρ' Ω J and g = Σ Jᵀ ρ' Ω e, J by increments δ in
    the frame of a pose, X ∘ (dx, dy, dθ), and D = diag H.

    Args:
        graph: outside of a trace it is checked.
        factors: the factor of each table; those of files by default. A table "name/part" takes the
            factor "name".
        method: "levenberg_marquardt", "gauss_newton" (λ = 0, every step is taken) or "dogleg".
        kernel: robust kernels, one for all tables or by table.
        iterations: steps at most.
        tolerance: done when a step lowers χ² by less than this share of it, as the quadratic model
            predicts, and at least by rounding.
        plan: of `plan`; needed under `jit` and `vmap`, where `who` is traced.
    Raises:
        ValueError: on what `check_graph` refuses, and on unknown methods or tables.
    """
    caller = "graphs.optimize"
    if method not in METHODS:
        raise ValueError(f"{caller}: no method {method!r}; there are: {', '.join(METHODS)}")
    check_count(f"{caller}: iterations", iterations)
    known = factors_of(caller, graph, factors)
    check_graph(caller, graph, known)
    kernels = kernels_of(caller, graph, kernel)
    plan = plan_for(caller, graph, known, plan)
    model = model_of(tuple(known.items()), tuple(kernels.items()))
    limits = np.asarray(iterations), np.asarray(tolerance, float)
    return programs.call(_optimize, (model, method), graph, plan, *limits)


def chi2(
    graph: Graph,
    factors: Mapping[str, Factor] | None = None,
    *,
    kernel: Kernel | Mapping[str, Kernel] | None = None,
) -> Float[Array, ""]:
    """χ² = Σ ρ(eᵀ Ω e) of a graph as it is, without a factor ½."""
    known = factors_of("graphs.chi2", graph, factors)
    kernels = kernels_of("graphs.chi2", graph, kernel)
    model = model_of(tuple(known.items()), tuple(kernels.items()))
    return programs.call(_chi2, (model,), graph)


def _chi2(model: Model, graph: Graph) -> Float[Array, ""]:
    graph = in_one_dtype(graph)
    who = {name: table.who for name, table in graph.tables.items()}
    batch = _with_batch(graph)
    none = jnp.arange(len(graph.poses) + len(graph.points))
    return cost(model, who, variables_of(batch), data_of(batch, none))[0]


def in_one_dtype(graph: Graph) -> Graph:
    """The graph with its numbers in one precision, the highest of them."""
    numbers = [graph.poses, graph.points]
    numbers += [x for table in graph.tables.values() for x in (table.z, table.information)]
    dtype = jnp.result_type(*numbers)

    def one(x: Array) -> Array:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return cast(Graph, jax.tree.map(one, graph))


def _with_batch(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x)[..., None], tree)


def _optimize(
    model: Model, method: str, graph: Graph, plan: Plan, iterations: Array, tolerance: Array
) -> Solution:
    graph = in_one_dtype(graph)
    shared = plan, iterations, tolerance.astype(graph.poses.dtype)
    return cast(
        Solution,
        jax.tree.map(lambda x: x[..., 0], _batched(model, method)(shared, _with_batch(graph))),
    )


@functools.lru_cache(maxsize=256)
def _batched(model: Model, method: str) -> Any:
    """The solution of graphs with a last axis B; under `vmap` the batch becomes larger."""

    @jax.custom_batching.custom_vmap
    def solve(shared: tuple[Plan, Array, Array], graph: Graph) -> Solution:
        return minimize(model, method, *shared, graph)

    @solve.def_vmap
    def rule(size: int, batched: Any, shared: Any, graph: Graph) -> tuple[Solution, Any]:
        if any(jax.tree.leaves(batched[0])):
            raise ValueError("graphs.optimize: the plan is one for all graphs of a batch")

        def fold(x: Array, one: bool) -> Array:
            x = (
                jnp.moveaxis(x, 0, -2)
                if one
                else jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], size, x.shape[-1]))
            )
            return x.reshape(*x.shape[:-2], size * x.shape[-1])

        out = solve(shared, jax.tree.map(fold, graph, batched[1]))
        out = jax.tree.map(
            lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], size, x.shape[-1] // size), -2, 0), out
        )
        return out, jax.tree.map(lambda _: True, out)

    return solve
