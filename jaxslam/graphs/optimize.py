"""The optimum of a graph: Gauss-Newton and Levenberg-Marquardt on sparse blocks."""

import functools
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam import programs
from jaxslam.graphs.factor import Factor
from jaxslam.graphs.graph import Graph
from jaxslam.graphs.kernels import Kernel
from jaxslam.graphs.linearized import (
    Model,
    Variables,
    cost,
    data_of,
    linearize,
    retract,
    variables_of,
)
from jaxslam.graphs.plan import Plan, factors_of, plan_for
from jaxslam.graphs.steps import METHODS, damped, dot
from jaxslam.graphs.validation import check_graph
from jaxslam.validation.numbers import check_count

FIRST_DAMPING = 1e-4
"""λ of the first step, as a share of the diagonal."""


class Ending(IntEnum):
    """The reason for the end of the iterations: the `status` of a `Solution`."""

    CONVERGED = 0
    """The next step lowers χ² by less than the tolerance, and the information is regular."""
    STALLED = 1
    """No step lowers χ²: rounding, or a residual whose derivatives are wrong."""
    DIVERGED = 2
    """χ² is not finite, or Gauss-Newton ended above its start."""
    SINGULAR = 3
    """The measurements do not determine the variable `singular`; where the method damps its steps
    it went on and χ² is a minimum."""
    EXHAUSTED = 4
    """All iterations were made."""


class Solution(NamedTuple):
    """What `optimize` found; leading axes by `vmap`."""

    graph: Graph
    """with poses and points of the last iterate"""
    chi2: Float[Array, ""]
    """χ² = Σ ρ(eᵀ Ω e), without a factor ½"""
    status: Int[Array, ""]
    """an `Ending`"""
    iterations: Int[Array, ""]
    """steps that were tried"""
    singular: Int[Array, ""]
    """the first variable that the measurements do not determine, poses before points; -1: none"""
    chi2_start: Float[Array, ""]
    gradient: Float[Array, ""]
    """length of ½ ∂χ²/∂(increments) at the last iterate"""
    gradient_start: Float[Array, ""]


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


class Search(NamedTuple):
    """The state of the iterations; every array but the variables is (B,)."""

    variables: Variables
    chi2: Float[Array, "B"]
    damping: Float[Array, "B"]
    going: Bool[Array, "B"]
    ending: Int[Array, "B"]
    taken: Int[Array, "B"]
    singular: Int[Array, "B"]
    refused: Bool[Array, "B"]
    """no undamped step lowers χ² from here"""


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
        return _solve(model, method, *shared, graph)

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


def _solve(
    model: Model, method: str, plan: Plan, iterations: Array, tolerance: Array, graph: Graph
) -> Solution:
    data = data_of(graph, plan.column)
    start = variables_of(graph)
    first = linearize(model, plan, start, data)
    batch, dtype = first.chi2.shape, first.chi2.dtype
    eps = float(jnp.finfo(dtype).eps)
    finite = jnp.isfinite(first.chi2)
    none = jnp.zeros(batch, jnp.int32)
    begin = Search(
        variables=start,
        chi2=first.chi2,
        damping=jnp.full(batch, FIRST_DAMPING if method == "levenberg_marquardt" else 0.0, dtype),
        going=finite,
        ending=jnp.where(finite, none + Ending.EXHAUSTED, none + Ending.DIVERGED),
        taken=none,
        singular=none - 1,
        refused=jnp.zeros(batch, bool),
    )

    def again(search: Search) -> Array:
        return search.going.any()

    def iterate(search: Search) -> Search:
        system = linearize(model, plan, search.variables, data)
        step = damped(plan.cholesky, system, plan.on_diagonal, search.damping)
        moved = retract(search.variables, step.increments, plan)
        value = cost(model, plan.who, moved, data)
        regular = step.regular.all(axis=0)
        culprit = plan.order[jnp.argmin(step.regular, axis=0)].astype(jnp.int32)
        least = jnp.maximum(tolerance, 32 * eps) * (search.chi2 + 1)
        small = regular & (step.predicted <= least)
        finite = jnp.isfinite(value)
        ratio = (search.chi2 - value) / jnp.where(step.predicted > 0, step.predicted, 1.0)
        if method == "gauss_newton":
            good = regular & finite
            ending = jnp.where(small, Ending.CONVERGED, search.ending)
            ending = jnp.where(regular, ending, Ending.SINGULAR)
            ending = jnp.where(regular & ~finite, Ending.DIVERGED, ending)
            done = small | ~good
            damping = search.damping
            singular = jnp.where(regular, search.singular, culprit)
        else:
            good = regular & finite & (value <= search.chi2) & (small | (ratio > 1e-3))
            plain = search.damping == 0
            known = search.singular >= 0
            singular = jnp.where(plain & ~regular & ~known, culprit, search.singular)
            known = singular >= 0
            done = small & (plain | known | search.refused)
            ending = jnp.where(small & plain, Ending.CONVERGED, search.ending)
            ending = jnp.where(small & ~plain & search.refused, Ending.STALLED, ending)
            ending = jnp.where(small & known, Ending.SINGULAR, ending)
            lost = ~good & (search.damping > 1e8)
            ending = jnp.where(lost & ~done, Ending.STALLED, ending)
            done = done | lost
            lower = jnp.where(
                search.damping < 1e-8, jnp.where(known, search.damping, 0.0), search.damping / 30
            )
            damping = jnp.where(ratio > 0.5, lower, search.damping)
            damping = jnp.where(good & (ratio < 0.1), jnp.maximum(3 * search.damping, 0), damping)
            damping = jnp.where(good, damping, jnp.maximum(10 * search.damping, 1e-4))
            damping = jnp.where(small & ~known, 0.0, damping)
        take = search.going & good
        refused = jnp.where(take, False, search.refused | (~good & regular & (search.damping == 0)))
        taken = search.taken + search.going
        spent = taken >= iterations
        variables = jax.tree.map(
            lambda new, old: jnp.where(take[None, None], new, old), moved, search.variables
        )
        after = Search(
            variables=variables,
            chi2=jnp.where(take, value, search.chi2),
            damping=damping,
            going=search.going & ~done & ~spent,
            ending=ending.astype(jnp.int32),
            taken=taken,
            singular=singular,
            refused=refused,
        )
        held = jax.tree.map(
            lambda new, old: jnp.where(search.going, new, old), after[1:], search[1:]
        )
        return Search(variables, *held)

    end = jax.lax.while_loop(again, iterate, begin)
    last = linearize(model, plan, end.variables, data).gradient
    ending = end.ending
    if method == "gauss_newton":
        rose = (ending == Ending.EXHAUSTED) & (end.chi2 > first.chi2)
        ending = jnp.where(rose, Ending.DIVERGED, ending)
    return Solution(
        graph=graph._replace(poses=end.variables.poses, points=end.variables.points),
        chi2=end.chi2,
        status=ending,
        iterations=end.taken,
        singular=end.singular,
        chi2_start=first.chi2,
        gradient=jnp.sqrt(dot(last, last)),
        gradient_start=jnp.sqrt(dot(first.gradient, first.gradient)),
    )
