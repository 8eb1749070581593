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
"""at most"""
_GROWTH = 1.4
"""of μ in each round"""
_LAST_MU = 1e6
"""μ at which nearly all weights are zeros or ones"""
_LOOSE_TOLERANCE = 1e-6
"""tolerance of the rounds before the last"""


class _Round(NamedTuple):
    """The state of the rounds of B graphs."""

    found: Solution
    weights: dict[str, Float[Array, "E B"]]
    control: Float[Array, "B"]
    """μ: the surrogate is convex near zero, and the truncated cost at infinity"""
    settled: Bool[Array, "B"]
    """the weights are zeros and ones, and were before the last optimization"""
    rounds: Int[Array, ""]


def graduated(
    model: Model, plan: Plan, iterations: Array, tolerance: Array, graph: Graph
) -> Solution:
    """The solutions of graphs with a last axis B, whose model has truncated kernels.

    Yang et al. 2020, "Graduated non-convexity for robust spatial perception: from non-minimal
    solvers to global outlier rejection", RA-L 5(2). Rounds of weighted least squares: with s = eᵀΩe
    before the round, a row has the weight

        1 if s <= μ c²/(μ + 1), 0 if s >= (μ + 1) c²/μ, else c √(μ(μ + 1)/s) - μ

    and μ grows by 1.4 a round, at least to c²/(2 max s - c²), until all weights are zeros or ones.
    In the paper the first round has all weights one. Here it has those of the start's residuals,
    zeros and ones where s <= c² for half of the rows or more: false loops can bend the plain
    optimum by more than later rounds mend, and a good start must not be given up for it.
    """
    kernels = model.kernels.items()
    truncated = {name: kernel for name, kernel in kernels if isinstance(kernel, Truncated)}
    plain = Model(model.factors, {name: k for name, k in kernels if name not in truncated})
    data = data_of(graph, plan.column)

    def solved(graph: Graph, weights: dict[str, Array], tolerance: Array) -> Solution:
        tables = dict(graph.tables)
        for name, weight in weights.items():
            table = tables[name]
            tables[name] = table._replace(information=table.information * weight[:, None, None])
        return minimize(plain, plan, iterations, tolerance, graph._replace(tables=tables))

    def ratios(found: Solution) -> dict[str, Array]:
        """s/c² of the rows that can be left out."""
        here = variables_of(found.graph)
        held = held_data(model, plan.who, here, data)
        out = {}
        for name, factor in model.factors.items():
            if name in truncated:
                s = row_costs(
                    factor,
                    None,
                    plan.who[name],
                    here,
                    held.z[name],
                    held.information[name],
                )[1]
                out[name] = truncated[name].ratio(jnp.where(data.valid[name], s, 0.0))
        return out

    def convex(ratio: dict[str, Array]) -> Float[Array, "B"]:
        """The μ up to which the surrogate is convex over all rows, from s/c²."""
        worst = jnp.stack([r.max(axis=0, initial=0.0) for r in ratio.values()]).max(axis=0)
        return 1.0 / jnp.maximum(2 * worst - 1.0, 1.0 / _LAST_MU)

    def again(state: _Round) -> Array:
        return ~state.settled.all() & (state.rounds < _MAX_ROUNDS)

    def work(state: _Round) -> _Round:
        """The optimum with the weights, then the weights there."""
        binary = jnp.stack([_binary(w) for w in state.weights.values()]).all(axis=0)
        new = solved(state.found.graph, state.weights, jnp.where(binary, tolerance, loose))
        first = state.rounds == 0
        new = new._replace(
            graph=new.graph._replace(tables=graph.tables),
            iterations=state.found.iterations + new.iterations,
            chi2_start=jnp.where(first, new.chi2_start, state.found.chi2_start),
            gradient_start=jnp.where(first, new.gradient_start, state.found.gradient_start),
        )
        found = jax.tree.map(
            lambda a, b: jnp.where(state.settled[(None,) * (a.ndim - 1)], b, a), new, state.found
        )
        ratio = ratios(found)
        control = jnp.maximum(_GROWTH * state.control, convex(ratio))
        weights = {name: _weight(r, control[None]) for name, r in ratio.items()}
        same = [(weights[name] == state.weights[name]).all(axis=0) for name in weights]
        settled = state.settled | (binary & jnp.stack(same).all(axis=0))
        return _Round(found, weights, control, settled, state.rounds + 1)

    batch = graph.poses.shape[-1:]
    zero, none = jnp.zeros(batch, graph.poses.dtype), jnp.zeros(batch, jnp.int32)
    loose = jnp.maximum(tolerance, jnp.asarray(_LOOSE_TOLERANCE, tolerance.dtype))
    every = row_weights(plain, plan.who, variables_of(graph), data)
    start = Solution(graph, zero, none, none, none - 1, zero, zero, zero, every)
    ratio = ratios(start)
    rows = jnp.concatenate([data.valid[name] for name in ratio])
    fitting = rows & (jnp.concatenate(list(ratio.values())) <= 1.0)
    good = 2 * fitting.sum(axis=0) >= rows.sum(axis=0)
    control = jnp.where(good, _LAST_MU, convex(ratio))
    weights = {name: _weight(r, control[None]) for name, r in ratio.items()}
    state = _Round(start, weights, control, jnp.zeros(batch, bool), jnp.zeros((), jnp.int32))
    end = jax.lax.while_loop(again, work, state)
    found, converged = end.found, end.found.status == Ending.CONVERGED
    return found._replace(
        chi2=chi2_of(model, plan.who, variables_of(found.graph), data),
        weights=row_weights(model, plan.who, variables_of(found.graph), data),
        status=jnp.where(converged & ~end.settled, Ending.EXHAUSTED, found.status),
    )


def _binary(weight: Float[Array, "E B"]) -> Bool[Array, "B"]:
    return ((weight == 0) | (weight == 1)).all(axis=0)


def _weight(ratio: Float[Array, "E B"], control: Float[Array, "1 B"]) -> Float[Array, "E B"]:
    """The weight of rows by s/c² and μ."""
    low, high = control / (control + 1), (control + 1) / control
    safe = jnp.where(ratio > 0, ratio, 1.0)
    between = jnp.sqrt(control * (control + 1) / safe) - control
    return jnp.where(ratio <= low, 1.0, jnp.where(ratio >= high, 0.0, between))
