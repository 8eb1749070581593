"""Truncated least squares by graduated non-convexity."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.kernels import Truncated
from jaxslam.graphs._solver.linearized import (
    chi2_of,
    data_of,
    held_data,
    row_costs,
    row_weights,
    variables_of,
)
from jaxslam.graphs._solver.model import Model
from jaxslam.graphs._solver.plans import Plan
from jaxslam.graphs._solver.search import Ending, Solution, minimize

_MAX_ROUNDS = 100
"""The largest number of rounds; some 40 lead from μ = 1 to `_LAST_MU`."""
_GROWTH = 1.4
"""The factor of μ from round to round, as in the paper."""
_LAST_MU = 1e6
"""μ at which nearly all weights are zeros or ones."""
_LOOSE_TOLERANCE = 1e-6
"""Tolerance of the rounds before the last: their optima are only starts of the next."""


class _Round(NamedTuple):
    """The state of the rounds of B graphs."""

    solution: Solution
    weights: dict[str, Float[Array, "E B"]]
    control: Float[Array, "B"]
    """μ: the surrogate is convex near zero, and the truncated cost at infinity"""
    settled: Bool[Array, "B"]
    """the weights are zeros and ones, and the last optimization left them as they were"""
    rounds: Int[Array, ""]


def minimize_truncated(
    model: Model, plan: Plan, iterations: Array, tolerance: Array, graph: Graph
) -> Solution:
    """The solutions of graphs with a last axis B whose model has truncated kernels.

    Yang et al. 2020, "Graduated non-convexity for robust spatial perception: from non-minimal
    solvers to global outlier rejection", RA-L 5(2). Rounds of weighted least squares: with s = eᵀΩe
    before the round, a row has the weight

        1 if s <= μ c²/(μ + 1), 0 if s >= (μ + 1) c²/μ, else c √(μ(μ + 1)/s) - μ

    and μ grows by 1.4 a round, at least to c²/(2 max s - c²), until all weights are zeros or ones.
    In the paper the first round has all weights one. Here it has the weights for the residuals of
    the start, zeros and ones where s <= c² for half of the rows or more: false loops can bend the
    plain optimum by more than later rounds mend, and a good start must not be given up for it.
    """
    kernels = model.kernels.items()
    truncated = {name: kernel for name, kernel in kernels if isinstance(kernel, Truncated)}
    plain = Model(model.factors, {name: k for name, k in kernels if name not in truncated})
    data = data_of(graph, plan.column)

    def minimize_weighted(graph: Graph, weights: dict[str, Array], tolerance: Array) -> Solution:
        tables = dict(graph.tables)
        for name, weight in weights.items():
            table = tables[name]
            tables[name] = table._replace(information=table.information * weight[:, None, None])
        return minimize(plain, plan, iterations, tolerance, graph._replace(tables=tables))

    def ratios(solution: Solution) -> dict[str, Float[Array, "E B"]]:
        """s/c² of the rows that can be left out."""
        at = variables_of(solution.graph)
        held = held_data(model, plan.who, at, data)
        by_table = {}
        for name, kernel in truncated.items():
            factor, z, information = model.factors[name], held.z[name], held.information[name]
            s = row_costs(factor, None, plan.who[name], at, z, information)[1]
            by_table[name] = kernel.ratio(jnp.where(data.valid[name], s, 0.0))
        return by_table

    def convex_control(ratio: dict[str, Float[Array, "E B"]]) -> Float[Array, "B"]:
        """The μ up to which the surrogate is convex over all rows, from s/c²."""
        worst = jnp.stack([r.max(axis=0, initial=0.0) for r in ratio.values()]).max(axis=0)
        return 1.0 / jnp.maximum(2 * worst - 1.0, 1.0 / _LAST_MU)

    def next_round(state: _Round) -> _Round:
        """The optimum with the weights, then the weights there."""
        before = state.solution
        binary = jnp.stack([((w == 0) | (w == 1)).all(axis=0) for w in state.weights.values()]).all(
            axis=0
        )
        tolerances = jnp.where(binary, tolerance, loose)
        solution = minimize_weighted(before.graph, state.weights, tolerances)
        first = state.rounds == 0
        solution = solution._replace(
            graph=solution.graph._replace(tables=graph.tables),
            iterations=before.iterations + solution.iterations,
            chi2_start=jnp.where(first, solution.chi2_start, before.chi2_start),
            gradient_start=jnp.where(first, solution.gradient_start, before.gradient_start),
        )
        solution = jax.tree.map(
            lambda a, b: jnp.where(state.settled[(None,) * (a.ndim - 1)], b, a), solution, before
        )
        ratio = ratios(solution)
        control = jnp.maximum(_GROWTH * state.control, convex_control(ratio))
        weights = {name: _weight(r, control[None]) for name, r in ratio.items()}
        same = [(weights[name] == state.weights[name]).all(axis=0) for name in weights]
        settled = state.settled | (binary & jnp.stack(same).all(axis=0))
        return _Round(solution, weights, control, settled, state.rounds + 1)

    batch = graph.poses.shape[-1:]
    zero, none = jnp.zeros(batch, graph.poses.dtype), jnp.zeros(batch, jnp.int32)
    loose = jnp.maximum(tolerance, jnp.asarray(_LOOSE_TOLERANCE, tolerance.dtype))
    weights = row_weights(plain, plan.who, variables_of(graph), data)
    start = Solution(graph, zero, none, none, none - 1, zero, zero, zero, weights)
    ratio = ratios(start)
    # A start that half of the rows fit is good: its weights are zeros and ones at once.
    rows = jnp.concatenate([data.valid[name] for name in ratio])
    fitting = rows & (jnp.concatenate(list(ratio.values())) <= 1.0)
    good = 2 * fitting.sum(axis=0) >= rows.sum(axis=0)
    control = jnp.where(good, _LAST_MU, convex_control(ratio))
    weights = {name: _weight(r, control[None]) for name, r in ratio.items()}
    end = jax.lax.while_loop(
        lambda state: ~state.settled.all() & (state.rounds < _MAX_ROUNDS),
        next_round,
        _Round(start, weights, control, jnp.zeros(batch, bool), jnp.zeros((), jnp.int32)),
    )
    solution, converged = end.solution, end.solution.status == Ending.CONVERGED
    variables = variables_of(solution.graph)
    # χ² and weights of the truncated kernels, not of the surrogate.
    return solution._replace(
        chi2=chi2_of(model, plan.who, variables, data),
        weights=row_weights(model, plan.who, variables, data),
        status=jnp.where(converged & ~end.settled, Ending.EXHAUSTED, solution.status),
    )


def _weight(ratio: Float[Array, "E B"], control: Float[Array, "1 B"]) -> Float[Array, "E B"]:
    """The weight of rows by s/c² and μ (`minimize_truncated`)."""
    low, high = control / (control + 1), (control + 1) / control
    safe = jnp.where(ratio > 0, ratio, 1.0)
    # c √(μ(μ + 1)/s) - μ, by s/c²; 1 at the lower threshold and 0 at the upper.
    between = jnp.sqrt(control * (control + 1) / safe) - control
    return jnp.where(ratio <= low, 1.0, jnp.where(ratio >= high, 0.0, between))
