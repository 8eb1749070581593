"""The optimum of a graph, by Levenberg-Marquardt on sparse blocks, and its squared residuals.

Derivatives of the optimum are by implicit differentiation.
"""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxslam.core._numbers import is_concrete
from jaxslam.core.validation import at_least, finite, refusals_of, require
from jaxslam.graphs._checks import check_graph
from jaxslam.graphs._factor import Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.batch import (
    cut,
    graph_in_one_dtype,
    original_number,
    over_batch,
    padded_graph,
    with_batch,
)
from jaxslam.graphs._solver.gnc import minimize_truncated
from jaxslam.graphs._solver.kernels import Kernel, Truncated
from jaxslam.graphs._solver.linearized import (
    Variables,
    chi2_of,
    data_of,
    half_hessian,
    linearize,
    retract,
    row_weights,
    variables_of,
)
from jaxslam.graphs._solver.model import Model, factors_of, model_of
from jaxslam.graphs._solver.plans import Plan, plan_for
from jaxslam.graphs._solver.search import Solution, minimize
from jaxslam.graphs._sparse.cholesky import factorize, substitute


def squared_residuals(
    graph: Graph, factors: Mapping[str, Factor] | None = None, *, room: int = 0
) -> dict[str, Float[Array, "E"]]:
    """The squared residual eᵀ Ω e of every row of every table, 0 where not valid; their sum is χ².

    Of a row with R residuals, at the truth and with the right Ω, it is χ² distributed with R
    degrees of freedom. factors, room: see `optimize`.
    """
    with refusals_of("graphs.squared_residuals"):
        factors = factors_of(graph, factors)
    squares = _squares_of(factors, padded_graph(graph, room) if is_concrete(graph) else graph)
    return {key: cut(square, graph.tables[key].valid) for key, square in squares.items()}


def degrees_of_freedom(graph: Graph, factors: Mapping[str, Factor] | None = None) -> int:
    """The residuals of all valid rows minus the free numbers of poses and points."""
    with refusals_of("graphs.degrees_of_freedom"):
        factors = factors_of(graph, factors)
    residuals = sum(
        int(table.valid.sum()) * len(factors[key].errors) for key, table in graph.tables.items()
    )
    free = 3 * int((~graph.fixed_pose).sum())
    return residuals - free - graph.points.shape[1] * int((~graph.fixed_point).sum())


@partial(jax.jit, inline=True)
def _squares_of(factors: dict[str, Factor], graph: Graph) -> dict[str, Float[Array, "E"]]:
    squares = {}
    for key, factor in factors.items():
        table = graph.tables[key]

        def square(who: Array, z: Array, information: Array, factor: Factor = factor) -> Array:
            values = tuple(
                (graph.poses if kind == "pose" else graph.points)[who[k]]
                for k, kind in enumerate(factor.variables)
            )
            e = factor.residual(values, z)
            if factor.whiten is not None:
                e = factor.whiten(values, z) @ e
            return e @ information @ e

        who, z, information = (jnp.asarray(part) for part in table[:3])
        squares[key] = jnp.where(table.valid, jax.vmap(square)(who, z, information), 0.0)
    return squares


_HELD_STEPS = 20
"""Steps of `attach_derivatives` where factors whiten. With σ a share a of the range, each leaves
some 2a of the error."""


def attach_derivatives(model: Model, plan: Plan, graph: Graph, solution: Solution) -> Solution:
    """The solution, with derivatives by graph and model.

    At the optimum F(δ; θ) = ½ ∂χ²/∂δ = 0, so that dδ = -(∂F/∂δ)⁻¹ (∂F/∂θ) dθ: a Newton step from
    the optimum, of which only F is differentiated. ∂F/∂δ is half the Hessian of χ² with its second
    derivatives of the residuals, not Gauss-Newton's. θ are the measurements, the information,
    the variables that are fixed, and the numbers of factors and kernels.

    Where factors whiten (`Factor.whiten`), F has W at the variables, and ∂F/∂δ is not symmetric.
    Several steps then have H, ∂F/∂δ for a fixed W, in its place:
    dδ ← dδ - H⁻¹ (∂F/∂δ dδ + ∂F/∂θ dθ), whose fixed point is the same.
    """
    optimum = jax.lax.stop_gradient((solution.graph.poses, solution.graph.points))
    poses = jnp.where(graph.fixed_pose[:, None], graph.poses, optimum[0])
    points = jnp.where(graph.fixed_point[:, None], graph.points, optimum[1])
    trial = with_batch(graph._replace(poses=poses, points=points))
    variables, data = variables_of(trial), data_of(trial, plan.column)
    blocks = half_hessian(*jax.lax.stop_gradient((model, plan, variables, data)))

    def newton(at: Variables) -> Variables:
        gradient = linearize(model, plan, at, data).gradient
        step = _solve(plan, blocks[..., 0], gradient[..., 0])
        return retract(at, -step[..., None], plan)

    # Only the derivative of this step is used: the optimum itself is that of the solution.
    end = newton(variables)
    if model.holds:
        end = jax.lax.fori_loop(1, _HELD_STEPS, lambda _, at: newton(at), end)
    weights = row_weights(model, plan.who, end, data)
    return jax.lax.stop_gradient(solution)._replace(
        graph=graph._replace(poses=end.poses[..., 0], points=end.points[..., 0]),
        # Where W is held, χ² is not stationary at the optimum: its derivative needs that of `end`.
        chi2=chi2_of(model, plan.who, end if model.holds else variables, data)[0],
        weights={name: weight[..., 0] for name, weight in weights.items()},
    )


def _solve(
    plan: Plan, blocks: Float[Array, "M d d"], rhs: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """The solution A⁻¹ b, with derivatives by b."""

    def multiply(x: Float[Array, "n d"]) -> Float[Array, "n d"]:
        # Blocks are stored for the lower triangle; the upper one has their transposes.
        lower = jnp.einsum("mij,mj->mi", blocks, x[plan.block_column])
        upper = jnp.einsum("mji,mj->mi", blocks, x[plan.block_row])
        upper = jnp.where(plan.on_diagonal[:, None], 0.0, upper)
        y = jnp.zeros_like(x).at[plan.block_row].add(lower)
        return y.at[plan.block_column].add(upper)

    def solve(_: object, b: Float[Array, "n d"]) -> Float[Array, "n d"]:
        return _solve_by_factor((plan,), (blocks, b))

    x: Array = jax.lax.custom_linear_solve(multiply, rhs, solve, symmetric=True)
    return x


@over_batch
def _solve_by_factor(plan: Plan, system: tuple[Array, Array]) -> Array:
    """The solutions A⁻¹ b of graphs with a last axis B, (blocks of A, b)."""
    blocks, rhs = system
    return substitute(plan.cholesky, factorize(plan.cholesky, blocks), rhs)


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
        iterations: largest number of steps; with 0 the solution is the graph itself.
        tolerance: done when a step lowers χ² by less than this share of it, as the quadratic model
            predicts, and at least by rounding.
        plan: of `plan`; needed under `jit` and `vmap`, where `who` is traced. Without one, graphs
            of about the same size share a compiled program (`padded_graph`).
        room: without a plan, graphs of up to about this number of variables share one.
    Raises:
        ValueError: on what `check_graph` refuses, and on unknown tables.
    """
    with refusals_of("graphs.optimize"):
        require("iterations", iterations, at_least(0))
        require("tolerance", tolerance, finite(least=0.0))
        model = model_of(graph, factors, kernel)
        check_graph(graph, model.factors)
        if plan is not None or not is_concrete(graph):
            plan = plan_for(graph, model.factors, plan, room=room)
            exact: Solution = _optimize(model, graph, plan, iterations, tolerance)
            return exact
        padded = padded_graph(graph, room)
        plan = plan_for(padded, model.factors, None, room=room)
    solution: Solution = _optimize(model, padded, plan, iterations, tolerance)
    rows = {name: table.valid for name, table in graph.tables.items()}
    return solution._replace(
        graph=cut(solution.graph, graph),
        singular=original_number(solution.singular, graph, padded),
        weights=cut(solution.weights, rows),
    )


def chi2(
    graph: Graph,
    factors: Mapping[str, Factor] | None = None,
    *,
    kernel: Kernel | Mapping[str, Kernel] | None = None,
) -> Float[Array, ""]:
    """The cost χ² = Σ ρ(eᵀ Ω e) of a graph as it is, without a factor ½."""
    with refusals_of("graphs.chi2"):
        model = model_of(graph, factors, kernel)
    cost: Array = _chi2(model, graph)
    return cost


@partial(jax.jit, inline=True)
def _chi2(model: Model, graph: Graph) -> Float[Array, ""]:
    graph = graph_in_one_dtype(graph)
    who = {name: jnp.asarray(table.who) for name, table in graph.tables.items()}
    batch = with_batch(graph)
    in_order = jnp.arange(len(graph.poses) + len(graph.points))  # without a plan
    return chi2_of(model, who, variables_of(batch), data_of(batch, in_order))[0]


@partial(jax.jit, inline=True)
def _optimize(
    model: Model, graph: Graph, plan: Plan, iterations: Array, tolerance: Array
) -> Solution:
    graph = graph_in_one_dtype(graph)
    tolerance = jnp.asarray(tolerance, graph.poses.dtype)
    return _differentiable_search(model, graph, plan, iterations, tolerance)


@over_batch
def _search(
    model: Model, plan: Plan, iterations: Array, tolerance: Array, graph: Graph
) -> Solution:
    """The solutions of graphs with a last axis B."""
    rounds = any(isinstance(kernel, Truncated) for kernel in model.kernels.values())
    search = minimize_truncated if rounds else minimize
    return search(model, plan, iterations, tolerance, graph)


@jax.custom_jvp
def _differentiable_search(
    model: Model, graph: Graph, plan: Plan, iterations: Array, tolerance: Array
) -> Solution:
    """The solution of one graph, with derivatives by the graph and by the numbers of the model."""
    return _search((model, plan, iterations, tolerance), graph)


@_differentiable_search.defjvp
def _slope(primals: PyTree, tangents: PyTree) -> tuple[Solution, PyTree]:
    model, graph, plan, *_ = primals
    solution = _differentiable_search(*primals)

    def near(model: Model, graph: Graph) -> Solution:
        return attach_derivatives(model, plan, graph, solution)

    return solution, jax.jvp(near, (model, graph), tangents[:2])[1]
