"""The iterations of an optimization: a trial step, its χ², and the decision."""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core._reprs import short_repr
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.linearized import (
    System,
    Variables,
    chi2_of,
    data_of,
    linearize,
    retract,
    row_weights,
    variables_of,
)
from jaxslam.graphs._solver.model import Model
from jaxslam.graphs._solver.plans import Plan
from jaxslam.graphs._sparse.cholesky import factorize, substitute


class _Step(NamedTuple):
    """An increment, and its prediction by the quadratic model of χ²."""

    increments: Float[Array, "n d B"]
    predicted: Float[Array, "B"]
    """decrease of χ²: -2 gᵀδ - δᵀHδ = λ δᵀDδ - gᵀδ"""
    regular: Bool[Array, "n B"]
    """of each column of the factor"""


def dot(a: Float[Array, "n d B"], b: Float[Array, "n d B"]) -> Float[Array, "B"]:
    """The inner product Σ a b over all variables."""
    return (a * b).sum(axis=(0, 1))


def _marquardt(plan: Plan, system: System, damping: Float[Array, "B"]) -> _Step:
    """The step of (H + λD) δ = -g, D = diag H.

    Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM
    11(2).
    """
    width = system.blocks.shape[1]
    unit = jnp.eye(width, dtype=bool)[None, ..., None] & plan.on_diagonal[:, None, None, None]
    # A variable without measurements has a diagonal of zero, and does not move.
    scale = jnp.where(system.blocks == 0, 1.0, system.blocks)
    blocks = system.blocks + jnp.where(unit, damping, 0.0) * scale
    factored = factorize(plan.cholesky, blocks)
    step = substitute(plan.cholesky, factored, -system.gradient)
    diagonal = jnp.diagonal(system.blocks[plan.cholesky.diagonal], axis1=1, axis2=2)
    square = dot(step * jnp.moveaxis(diagonal, 2, 1), step)
    return _Step(step, damping * square - dot(step, system.gradient), factored.regular)


_FIRST_DAMPING = 1e-7
"""λ after an undamped step that fails, as a share of the diagonal."""


class Ending(IntEnum):
    """The reason for the end of the iterations: the `status` of a `Solution`."""

    CONVERGED = 0
    """The next step lowers χ² by less than the tolerance, or than rounding of the coordinates does,
    and the information is regular."""
    STALLED = 1
    """No step lowers χ²: rounding, or a residual whose derivatives are wrong. Another start may
    end in a minimum."""
    DIVERGED = 2
    """χ² of the start is not finite."""
    SINGULAR = 3
    """The measurements do not determine the variable `singular`, at the last iterate, beyond the
    rounding of the numbers: in float32 a chain of some hundred poses from the gauge can be such.
    Damped steps went on, and χ² is a minimum."""
    EXHAUSTED = 4
    """All iterations were made. Another start may end, in fewer steps and lower."""


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
    weights: dict[str, Float[Array, "E"]]
    """ρ'(s) of the rows of each table at the last iterate, by which a kernel multiplies their
    information: 1 without a kernel, 0 of rows that are not valid"""

    def __repr__(self) -> str:
        return short_repr(self)


class _Search(NamedTuple):
    """The state of the iterations of B graphs."""

    trial: Variables
    predicted: Float[Array, "B"]
    """by how much the trial lowers χ² in the quadratic model"""
    stepped: Bool[Array, "B"]
    """whether the trial is another point than the iterate"""
    variables: Variables
    system: System
    """about the iterate"""
    damping: Float[Array, "B"]
    """λ"""
    going: Bool[Array, "B"]
    ending: Int[Array, "B"]
    taken: Int[Array, "B"]
    singular: Int[Array, "B"]
    refused: Bool[Array, "B"]
    """the undamped step from the iterate does not lower χ²"""
    careful: Bool[Array, "B"]
    """the last step was refused"""
    former: Float[Array, "B"]
    """χ² of the iterate before"""
    judged: Bool[Array, "B"]
    """the factor without damping was tried again at this iterate, where it is singular elsewhere"""


def minimize(
    model: Model, plan: Plan, iterations: Array, tolerance: Array, graph: Graph
) -> Solution:
    """The solutions of graphs with a last axis B."""
    data = data_of(graph, plan.column)
    start = variables_of(graph)
    width, batch, dtype = data.free.shape[1], start.poses.shape[-1:], start.poses.dtype
    blocks = jnp.zeros((*plan.block_column.shape, width, width, *batch), dtype)
    eps = float(jnp.finfo(dtype).eps)
    none, no = jnp.zeros(batch, jnp.int32), jnp.zeros(batch, bool)
    zero = jnp.zeros(batch, dtype)
    begin = _Search(
        trial=start,
        predicted=zero,
        stepped=~no,
        variables=start,
        system=System(zero + jnp.inf, jnp.zeros(data.free.shape, dtype), blocks),
        damping=zero,
        going=~no,
        ending=none + Ending.EXHAUSTED,
        taken=none - 1,
        singular=none - 1,
        refused=no,
        careful=no,
        former=zero,
        judged=no,
    )

    def iterate(carry: tuple[_Search, Array, Array]) -> tuple[_Search, Array, Array]:
        search, first_chi2, first_gradient = carry
        search = judged(search)
        starts = search.taken == 0
        first_chi2 = jnp.where(starts, search.system.chi2, first_chi2)
        norm = jnp.sqrt(dot(search.system.gradient, search.system.gradient))
        first_gradient = jnp.where(starts, norm, first_gradient)
        return proposed(search), first_chi2, first_gradient

    def judged(search: _Search) -> _Search:
        """The search after its trial is accepted or refused."""
        trial = linearize(model, plan, search.trial, data)
        finite, began = jnp.isfinite(trial.chi2), search.taken < 0
        lowered = trial.chi2
        if model.holds:
            lowered = chi2_of(model, plan.who, search.trial, data, held=search.variables)
        gain = search.system.chi2 - lowered
        ratio = gain / jnp.where(search.predicted > 0, search.predicted, 1.0)
        # A step hardly damped may go uphill, as far as the iterate before: it crosses curved
        # valleys along which damped steps crawl (Grippo, Lampariello and Lucidi 1986, "A
        # nonmonotone line search technique for Newton's method", SIAM J. Num. Analysis 23(4)).
        above = jnp.maximum(search.former - search.system.chi2, 0.0)
        slack = jnp.where(search.damping <= _FIRST_DAMPING, above, 0.0)
        good = finite & (began | (gain + slack > 1e-3 * search.predicted))
        active = search.going & search.stepped
        take = active & good
        refused = jnp.where(take, False, search.refused | (active & ~good & (search.damping == 0)))

        def chosen(new: Array, old: Array) -> Array:
            return jnp.where(take.reshape((1,) * (new.ndim - 1) + batch), new, old)

        lost = active & ~finite & began
        return search._replace(
            variables=jax.tree.map(chosen, search.trial, search.variables),
            system=jax.tree.map(chosen, trial, search.system),
            damping=jnp.where(active & ~began, damping_after(search, good, ratio), search.damping),
            going=search.going & ~lost,
            ending=jnp.where(lost, Ending.DIVERGED, search.ending).astype(jnp.int32),
            taken=search.taken + active.astype(jnp.int32),
            refused=refused,
            careful=jnp.where(active, ~good, search.careful),
            former=jnp.where(take & ~began, search.system.chi2, search.former),
            judged=search.judged & ~take,
        )

    def damping_after(search: _Search, good: Array, ratio: Array) -> Array:
        """The damping λ after a step: less after good ones, down to none; more after refused ones.

        The first good step after a refused one leaves it as it is.
        """
        known = search.singular >= 0
        least = jnp.where(known, 1e-10, 0.0)
        less = jnp.where(search.damping < 1e-10, least, search.damping / 10)
        kept = jnp.where((ratio > 0.25) & ~search.careful, less, search.damping)
        more = jnp.where(search.careful, 100.0, 10.0) * search.damping
        return jnp.where(good, kept, jnp.maximum(more, _FIRST_DAMPING))

    def unresolved(search: _Search) -> Float[Array, "B"]:
        """What a step of two ulp of the largest coordinates changes, δᵀ diag(H) δ; 0 where that is
        a tenth of a σ on average, and rounding spoils the result."""
        poses, points = search.variables
        ulp = [
            jnp.broadcast_to(jnp.abs(x).max(axis=1, keepdims=True), (len(x), width, *batch))
            for x in (poses[:, :2], points)
        ]
        ulp[0] = ulp[0].at[:, 2].set(jnp.pi)
        step = 2 * eps * jnp.concatenate(ulp)[plan.order]
        diagonal = jnp.diagonal(search.system.blocks[plan.cholesky.diagonal], axis1=1, axis2=2)
        change = dot(jnp.where(data.free, jnp.moveaxis(diagonal, 2, 1), 0.0) * step, step)
        return jnp.where(change < 0.01 * data.free.sum(axis=(0, 1)), change, 0.0)

    def proposed(search: _Search) -> _Search:
        """The search with its next trial, or at its end."""
        plain = search.damping == 0
        known = search.singular >= 0
        step = _marquardt(plan, search.system, search.damping)
        regular = step.regular.all(axis=0)
        culprit = plan.order[jnp.argmin(step.regular, axis=0)].astype(jnp.int32)
        singular = jnp.where(plain & ~regular & ~known, culprit, search.singular)
        chi2 = search.system.chi2
        least = jnp.maximum(tolerance * chi2, 32 * eps * (chi2 + 1))
        small = step.predicted <= jnp.maximum(least, unresolved(search))
        # Only regularity at the end matters, not on the way.
        singular = jnp.where(plain & regular & small, -1, singular)
        known = singular >= 0
        stuck = search.refused | (step.predicted <= 0)
        converged = small & (plain | (known & search.judged) | stuck)
        ending = jnp.where(known, Ending.SINGULAR, Ending.CONVERGED)
        # A gradient of exactly zero is not a stall.
        stalled = ~plain | (stuck & (step.predicted != 0))
        ending = jnp.where(~known & stalled, Ending.STALLED, ending)
        # Without a step: an undamped factor that failed, or that has to confirm convergence.
        more = jnp.maximum(10 * search.damping, _FIRST_DAMPING)
        damping = jnp.where(regular, search.damping, more)
        again = regular & small & ~plain & ~converged
        damping = jnp.where(again, 0.0, damping)
        stuck = ~converged & (damping > 1e10)
        converged, ending = converged | stuck, jnp.where(stuck, Ending.STALLED, ending)
        ends = search.going & converged
        return search._replace(
            trial=retract(search.variables, step.increments, plan),
            predicted=step.predicted,
            stepped=regular & (~small | plain),
            damping=jnp.where(search.going, damping, search.damping),
            going=search.going & ~converged & (search.taken < iterations),
            ending=jnp.where(ends, ending, search.ending).astype(jnp.int32),
            singular=jnp.where(search.going, singular, search.singular),
            judged=search.judged | (again & known),
        )

    end, first_chi2, first_gradient = jax.lax.while_loop(
        lambda carry: carry[0].going.any(), iterate, (begin, zero, zero)
    )
    return Solution(
        graph=graph._replace(poses=end.variables.poses, points=end.variables.points),
        chi2=end.system.chi2,
        status=end.ending,
        iterations=jnp.maximum(end.taken, 0),
        singular=end.singular,
        chi2_start=first_chi2,
        gradient=jnp.sqrt(dot(end.system.gradient, end.system.gradient)),
        gradient_start=first_gradient,
        weights=row_weights(model, plan.who, end.variables, data),
    )
