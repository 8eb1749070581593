"""The optimum of a graph: Levenberg-Marquardt on sparse blocks."""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxslam.core.numbers import check_count, is_concrete
from jaxslam.graphs.factor import Factor
from jaxslam.graphs.graph import Graph
from jaxslam.graphs.solver.batch import graph_in_one_dtype, over_batch, with_batch
from jaxslam.graphs.solver.gnc import graduated
from jaxslam.graphs.solver.implicit import followed
from jaxslam.graphs.solver.kernels import Kernel, Truncated
from jaxslam.graphs.solver.linearized import chi2_of, data_of, variables_of
from jaxslam.graphs.solver.model import Model, model_of
from jaxslam.graphs.solver.padding import cut, own_number, padded_graph
from jaxslam.graphs.solver.plan import Plan, plan_for
from jaxslam.graphs.solver.search import Solution, minimize
from jaxslam.graphs.validation import check_graph


def optimize(
    graph: Graph,
    factors: Mapping[str, Factor] | None = None,
    *,
    kernel: Kernel | Mapping[str, Kernel] | None = None,
    iterations: int = 100,
    tolerance: float = 1e-12,
    plan: Plan | None = None,
    room: int = 0,
) -> Solution:
    """The graph at a minimum of χ² = Σ ρ(eᵀ Ω e), from the variables it has.

    Each step of Levenberg and Marquardt solves (H + λD) δ = -g with H = Σ Jᵀ ρ' Ω J and
    g = Σ Jᵀ ρ' Ω e, J by increments δ in the frame of a pose, X ∘ exp(δ) as in `se2.boxplus`, and
    D = diag H.

    Args:
        graph: outside of a trace it is checked.
        factors: the factor of each table; those of files by default. A table "name/part" takes the
            factor "name".
        kernel: robust kernels, one for all tables or by table. With `Truncated` the iterations are
            rounds of graduated non-convexity (`gnc`), and `iterations` is the limit of each.
        iterations: steps at most; with 0 the solution is of the graph as it is.
        tolerance: done when a step lowers χ² by less than this share of it, as the quadratic model
            predicts, and at least by rounding.
        plan: of `plan`; needed under `jit` and `vmap`, where `who` is traced. Without one, graphs
            of about the same size share a compiled program (`solver.padding`).
        room: without a plan, all graphs of at most about so many variables share one.
    Raises:
        ValueError: on what `check_graph` refuses, and on unknown tables.
    """
    caller = "graphs.optimize"
    check_count(f"{caller}: iterations", iterations, least=0)
    if is_concrete(tolerance) and not 0 <= tolerance < np.inf:
        raise ValueError(
            f"{caller}: expected tolerance to be a finite number >= 0, got {tolerance}"
        )
    model = model_of(caller, graph, factors, kernel)
    check_graph(caller, graph, model.factors)
    own, fill = graph, plan is None and is_concrete(graph)
    graph = padded_graph(graph, room) if fill else graph
    plan = plan_for(caller, graph, model.factors, plan, room=room)
    found: Solution = _optimize(model, graph, plan, iterations, tolerance)
    if not fill:
        return found
    singular = own_number(found.singular, own, graph)
    rows = {name: table.valid for name, table in own.tables.items()}
    return found._replace(
        graph=cut(found.graph, own), singular=singular, weights=cut(found.weights, rows)
    )


def chi2(
    graph: Graph,
    factors: Mapping[str, Factor] | None = None,
    *,
    kernel: Kernel | Mapping[str, Kernel] | None = None,
) -> Float[Array, ""]:
    """The cost χ² = Σ ρ(eᵀ Ω e) of a graph as it is, without a factor ½."""
    cost: Array = _chi2(model_of("graphs.chi2", graph, factors, kernel), graph)
    return cost


@partial(jax.jit, inline=True)
def _chi2(model: Model, graph: Graph) -> Float[Array, ""]:
    graph = graph_in_one_dtype(graph)
    who = {name: jnp.asarray(table.who) for name, table in graph.tables.items()}
    batch = with_batch(graph)
    none = jnp.arange(len(graph.poses) + len(graph.points))
    return chi2_of(model, who, variables_of(batch), data_of(batch, none))[0]


@partial(jax.jit, inline=True)
def _optimize(
    model: Model, graph: Graph, plan: Plan, iterations: Array, tolerance: Array
) -> Solution:
    graph = graph_in_one_dtype(graph)
    return _solved(model, graph, plan, iterations, jnp.asarray(tolerance, graph.poses.dtype))


def _search(
    model: Model, plan: Plan, iterations: Array, tolerance: Array, graph: Graph
) -> Solution:
    """The solutions of graphs with a last axis B."""
    rounds = any(isinstance(kernel, Truncated) for kernel in model.kernels.values())
    return (graduated if rounds else minimize)(model, plan, iterations, tolerance, graph)


_solve = over_batch("graphs.optimize", _search)


@jax.custom_jvp
def _solved(
    model: Model, graph: Graph, plan: Plan, iterations: Array, tolerance: Array
) -> Solution:
    """The solution of one graph, with derivatives by the graph and by the numbers of the model."""
    return _solve((model, plan, iterations, tolerance), graph)


@_solved.defjvp
def _slope(primals: PyTree, tangents: PyTree) -> tuple[Solution, PyTree]:
    model, graph, plan, *_ = primals
    found = _solved(*primals)

    def near(model: Model, graph: Graph) -> Solution:
        return followed(model, plan, graph, found)

    return found, jax.jvp(near, (model, graph), tangents[:2])[1]
