"""The iterations of Levenberg and Marquardt: a trial step, its χ², and the decision.

`minimize` is the loop. Each pass evaluates the trial (`_accept`), then solves for the next one and
decides whether the search ends (`_propose`, `_ending_of`).
"""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core._reprs import short_repr
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.linearized import (
    Data,
    System,
    Variables,
    chi2_of,
    data_of,
    diagonal_of,
    dot,
    linearize,
    retract,
    row_weights,
    variables_of,
)
from jaxslam.graphs._solver.model import Model
from jaxslam.graphs._solver.plans import Plan
from jaxslam.graphs._sparse.cholesky import factorize, substitute

_FIRST_DAMPING = 1e-7
"""λ after an undamped step that fails, as a share of the diagonal of H."""

_LEAST_DAMPING = 1e-10
"""λ below which a step is undamped, or, where H has been singular, stays damped."""

_MOST_DAMPING = 1e10
"""λ above which the search stalls: the step is D⁻¹ g / λ, gradient descent by next to nothing."""

_FACTOR = 10.0
"""The factor of λ from step to step, Marquardt's ν."""

_STEEPER_FACTOR = 100.0
"""The factor of λ from the second refused step in a row on: fewer trials up to large λ."""

_SUFFICIENT = 1e-3
"""The share of the predicted decrease of χ² above which a trial is accepted. Trust regions take
some share in [0, 1/4) (Nocedal and Wright 2006, "Numerical optimization", algorithm 4.1)."""

_WELL_PREDICTED = 0.25
"""The share of the predicted decrease above which λ may fall (in the same algorithm: the radius
shrinks below it)."""

_SUM_ROUNDING = 32
"""The rounding of χ², a sum over rows, in eps of χ² + 1."""

_RESOLVED = 0.01
"""The change of χ² by the rounding of coordinates, per coordinate, up to which it may end a search:
a tenth of a σ, squared. A larger one spoils the result, and the search goes on."""


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
    """The result of `optimize`; leading axes by `vmap`."""

    graph: Graph
    """the graph at the poses and points of the last iterate"""
    chi2: Float[Array, ""]
    """χ² = Σ ρ(eᵀ Ω e), without a factor ½"""
    status: Int[Array, ""]
    """an `Ending`"""
    iterations: Int[Array, ""]
    """steps tried, accepted or refused"""
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


def _marquardt(
    plan: Plan, system: System, damping: Float[Array, "B"]
) -> tuple[Float[Array, "n d B"], Float[Array, "B"], Bool[Array, "n B"]]:
    """The step δ of (H + λD) δ = -g, D = diag H, the decrease of χ² that it predicts, and whether
    each column of the factor is regular.

    The decrease is that of the quadratic model of χ²: -2 gᵀδ - δᵀHδ = λ δᵀDδ - gᵀδ. Marquardt 1963,
    "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11(2).
    """
    width = system.blocks.shape[1]
    # The entries of D among the blocks (M, d, d, B).
    unit = jnp.eye(width, dtype=bool)[None, ..., None] & plan.on_diagonal[:, None, None, None]
    # A variable without measurements has a diagonal of zero, and does not move.
    scale = jnp.where(system.blocks == 0, 1.0, system.blocks)
    blocks = system.blocks + jnp.where(unit, damping, 0.0) * scale
    factored = factorize(plan.cholesky, blocks)
    step = substitute(plan.cholesky, factored, -system.gradient)
    square = dot(step * diagonal_of(plan, system.blocks), step)
    return step, damping * square - dot(step, system.gradient), factored.regular


class _Problem(NamedTuple):
    """The data of a search, for B graphs."""

    model: Model
    plan: Plan
    data: Data
    iterations: Int[Array, ""]
    tolerance: Float[Array, "*B"]


class _Search(NamedTuple):
    """The state of the iterations of B graphs. The iterate is the last point that was accepted."""

    begun: Bool[Array, ""]
    """the start has been evaluated"""
    trial: Variables
    """the point to evaluate next"""
    decrease: Float[Array, "B"]
    """predicted decrease of χ² from the iterate to the trial"""
    stepped: Bool[Array, "B"]
    """the trial is another point than the iterate; if not, only λ is another"""
    variables: Variables
    """the iterate"""
    system: System
    """about the iterate"""
    chi2_before: Float[Array, "B"]
    """χ² of the iterate before this one; 0 at the start"""
    damping: Float[Array, "B"]
    """λ"""
    undamped_refused: Bool[Array, "B"]
    """the undamped step from this iterate was refused"""
    undamped_again: Bool[Array, "B"]
    """after a damped step became small at this iterate, H was factorized without damping once
    more, though it had been singular at an earlier one"""
    trial_refused: Bool[Array, "B"]
    """the last trial was refused"""
    singular: Int[Array, "B"]
    """the variable at which an undamped factor failed, -1 without one"""
    steps: Int[Array, "B"]
    """trials evaluated, without the start"""
    going: Bool[Array, "B"]
    ending: Int[Array, "B"]
    """an `Ending`; EXHAUSTED while the search goes on"""
    chi2_start: Float[Array, "B"]
    gradient_start: Float[Array, "B"]


def minimize(
    model: Model, plan: Plan, iterations: Array, tolerance: Array, graph: Graph
) -> Solution:
    """The solutions of graphs with a last axis B, by the iterations of Levenberg and Marquardt."""
    problem = _Problem(model, plan, data_of(graph, plan.column), iterations, tolerance)
    # The start is the first trial: `linearize` is compiled once, within the loop.
    end = jax.lax.while_loop(
        lambda search: search.going.any(),
        lambda search: _propose(problem, _accept(problem, search)),
        _at_start(problem, variables_of(graph)),
    )
    return Solution(
        graph=graph._replace(poses=end.variables.poses, points=end.variables.points),
        chi2=end.system.chi2,
        status=end.ending,
        iterations=end.steps,
        singular=end.singular,
        chi2_start=end.chi2_start,
        gradient=jnp.sqrt(dot(end.system.gradient, end.system.gradient)),
        gradient_start=end.gradient_start,
        weights=row_weights(model, plan.who, end.variables, problem.data),
    )


def _at_start(problem: _Problem, start: Variables) -> _Search:
    """The search before the start is evaluated: its iterate has an infinite χ²."""
    batch, dtype = start.poses.shape[-1:], start.poses.dtype
    free = problem.data.free
    width = free.shape[1]
    blocks = jnp.zeros((*problem.plan.block_column.shape, width, width, *batch), dtype)
    none, no = jnp.zeros(batch, jnp.int32), jnp.zeros(batch, bool)
    zero = jnp.zeros(batch, dtype)
    return _Search(
        begun=jnp.asarray(False),
        trial=start,
        decrease=zero,
        stepped=~no,
        variables=start,
        system=System(zero + jnp.inf, jnp.zeros(free.shape, dtype), blocks),
        chi2_before=zero,
        damping=zero,
        undamped_refused=no,
        undamped_again=no,
        trial_refused=no,
        singular=none - 1,
        steps=none,
        going=~no,
        ending=none + Ending.EXHAUSTED,
        chi2_start=zero,
        gradient_start=zero,
    )


def _accept(problem: _Problem, search: _Search) -> _Search:
    """The search after its trial is evaluated, and is the new iterate or refused.

    A start that is not finite ends the search as DIVERGED. A later trial that is not finite is
    refused.
    """
    model, plan, data, *_ = problem
    begun = search.begun
    trial = linearize(model, plan, search.trial, data)
    finite = jnp.isfinite(trial.chi2)
    # Where noise depends on the variables, both χ² have that of the iterate: else a step would be
    # good that only makes the noise larger.
    chi2 = trial.chi2
    if model.holds:
        chi2 = chi2_of(model, plan.who, search.trial, data, held=search.variables)
    gain = search.system.chi2 - chi2
    ratio = gain / jnp.where(search.decrease > 0, search.decrease, 1.0)
    # A step hardly damped may go uphill, as far as the iterate before: it crosses curved
    # valleys along which damped steps crawl (Grippo, Lampariello and Lucidi 1986, "A
    # nonmonotone line search technique for Newton's method", SIAM J. Num. Analysis 23(4)).
    above = jnp.maximum(search.chi2_before - search.system.chi2, 0.0)
    slack = jnp.where(search.damping <= _FIRST_DAMPING, above, 0.0)
    good = finite & (~begun | (gain + slack > _SUFFICIENT * search.decrease))
    active = search.going & search.stepped
    accepted = active & good
    undamped_refused = active & ~good & (search.damping == 0)
    diverged = active & ~finite & ~begun

    def newer(new: Array, old: Array) -> Array:
        # (…, B): the mask is broadcast to the rank of the array.
        return jnp.where(accepted[(None,) * (new.ndim - 1)], new, old)

    system = jax.tree.map(newer, trial, search.system)
    steps = search.steps + (active & begun).astype(jnp.int32)
    gradient = jnp.sqrt(dot(system.gradient, system.gradient))
    return search._replace(
        begun=jnp.asarray(True),
        variables=jax.tree.map(newer, search.trial, search.variables),
        system=system,
        chi2_before=jnp.where(accepted & begun, search.system.chi2, search.chi2_before),
        damping=jnp.where(active & begun, _damping_after(search, good, ratio), search.damping),
        undamped_refused=jnp.where(accepted, False, search.undamped_refused | undamped_refused),
        undamped_again=search.undamped_again & ~accepted,
        trial_refused=jnp.where(active, ~good, search.trial_refused),
        steps=steps,
        going=search.going & ~diverged,
        ending=jnp.where(diverged, Ending.DIVERGED, search.ending).astype(jnp.int32),
        chi2_start=jnp.where(steps == 0, system.chi2, search.chi2_start),
        gradient_start=jnp.where(steps == 0, gradient, search.gradient_start),
    )


def _damping_after(
    search: _Search, good: Bool[Array, "B"], ratio: Float[Array, "B"]
) -> Float[Array, "B"]:
    """λ after a trial: less after a good one that was well predicted, more after a refused one.

    The first good step after a refused one leaves it as it is: with less, the next is likely to be
    refused again. ratio: the decrease of χ² over its prediction.
    """
    least = jnp.where(search.singular >= 0, _LEAST_DAMPING, 0.0)
    lower = jnp.where(search.damping < _LEAST_DAMPING, least, search.damping / _FACTOR)
    may_fall = (ratio > _WELL_PREDICTED) & ~search.trial_refused
    factor = jnp.where(search.trial_refused, _STEEPER_FACTOR, _FACTOR)
    higher = jnp.maximum(factor * search.damping, _FIRST_DAMPING)
    return jnp.where(good, jnp.where(may_fall, lower, search.damping), higher)


def _propose(problem: _Problem, search: _Search) -> _Search:
    """The search with its next trial, or at its end.

    `_ending_of` decides by the step δ of (H + λD) δ = -g whether the search ends. If not:

    | H + λD   | δ             | next trial | next λ |
    |----------|---------------|------------|--------|
    | singular |               | none       | higher |
    | regular  | small, damped | none       | 0      |
    | regular  | other         | x ⊞ δ      | λ      |

    A damped step that is small does not prove that the search has converged, since the factor is
    not that of H; hence λ = 0. A search whose next λ is above its maximum has stalled.
    """
    plan, chi2 = problem.plan, search.system.chi2
    undamped = search.damping == 0
    step, decrease, regular_columns = _marquardt(plan, search.system, search.damping)
    regular = regular_columns.all(axis=0)

    # Small: the tolerance, the rounding of χ², or that of the coordinates is larger.
    eps = float(jnp.finfo(chi2.dtype).eps)
    least = jnp.maximum(problem.tolerance * chi2, _SUM_ROUNDING * eps * (chi2 + 1))
    small = decrease <= jnp.maximum(least, _change_by_rounding(problem, search))

    # The variable at which H first failed; forgotten where H is regular at the end, which alone
    # matters, not the way there.
    failed = plan.order[jnp.argmin(regular_columns, axis=0)].astype(jnp.int32)
    fails_first = undamped & ~regular & (search.singular < 0)
    singular = jnp.where(fails_first, failed, search.singular)
    singular = jnp.where(undamped & regular & small, -1, singular)

    ends, ending = _ending_of(
        small=small,
        undamped=undamped,
        singular=singular >= 0,
        again=search.undamped_again,
        refused=search.undamped_refused,
        decrease=decrease,
    )
    to_confirm = regular & small & ~undamped & ~ends
    higher = jnp.maximum(_FACTOR * search.damping, _FIRST_DAMPING)
    damping = jnp.where(regular, jnp.where(to_confirm, 0.0, search.damping), higher)
    stalls = ~ends & (damping > _MOST_DAMPING)
    ends, ending = ends | stalls, jnp.where(stalls, Ending.STALLED, ending)

    # A search of the batch that is over keeps its λ, its ending and its singular variable.
    going = search.going
    return search._replace(
        trial=retract(search.variables, step, plan),
        decrease=decrease,
        stepped=regular & ~to_confirm,
        damping=jnp.where(going, damping, search.damping),
        undamped_again=search.undamped_again | (to_confirm & (singular >= 0)),
        singular=jnp.where(going, singular, search.singular),
        going=going & ~ends & (search.steps < problem.iterations),
        ending=jnp.where(going & ends, ending, search.ending).astype(jnp.int32),
    )


def _ending_of(
    *,
    small: Bool[Array, "B"],
    undamped: Bool[Array, "B"],
    singular: Bool[Array, "B"],
    again: Bool[Array, "B"],
    refused: Bool[Array, "B"],
    decrease: Float[Array, "B"],
) -> tuple[Bool[Array, "B"], Int[Array, "B"]]:
    """Whether a search ends at its iterate, and the `Ending`, by its next step.

    The step is blocked if the undamped one was refused, or if it predicts no decrease.

    | small | undamped | singular | again | blocked                | the search      |
    |-------|----------|----------|-------|------------------------|-----------------|
    | no    |          |          |       |                        | goes on         |
    | yes   | yes      | no       |       | no, or a decrease of 0 | ends: CONVERGED |
    | yes   | yes      | no       |       | else                   | ends: STALLED   |
    | yes   | yes      | yes      |       |                        | ends: SINGULAR  |
    | yes   | no       | no       |       | no                     | goes on         |
    | yes   | no       | no       |       | yes                    | ends: STALLED   |
    | yes   | no       | yes      | no    | no                     | goes on         |
    | yes   | no       | yes      | no    | yes                    | ends: SINGULAR  |
    | yes   | no       | yes      | yes   |                        | ends: SINGULAR  |

    Args:
        small: the step predicts a decrease of χ² below the tolerance or below rounding.
        undamped: λ = 0. Only then the factor is that of H.
        singular: an undamped factor failed, at this iterate or an earlier one.
        again: it was tried once more at this iterate (`_Search.undamped_again`).
        refused: the undamped step from this iterate was refused.
        decrease: predicted decrease of χ². It is exactly 0 where the gradient is, which is no
            stall.
    """
    blocked = refused | (decrease <= 0)
    ends = small & (undamped | (singular & again) | blocked)
    ending = jnp.where(singular, Ending.SINGULAR, Ending.CONVERGED)
    stalled = ~undamped | (blocked & (decrease != 0))
    return ends, jnp.where(~singular & stalled, Ending.STALLED, ending)


def _change_by_rounding(problem: _Problem, search: _Search) -> Float[Array, "B"]:
    """The change of χ² by rounding of the coordinates, δᵀ D δ with δ two ulp of the largest ones.

    0 where it is a tenth of a σ or more on average.
    """
    plan, free = problem.plan, problem.data.free
    poses, points = search.variables
    # The largest coordinate of each variable in all its d entries; angles are at most π.
    largest = [
        jnp.broadcast_to(jnp.abs(x).max(axis=1, keepdims=True), (len(x), *free.shape[1:]))
        for x in (poses[:, :2], points)
    ]
    largest[0] = largest[0].at[:, 2].set(jnp.pi)
    two_ulp = 2 * float(jnp.finfo(poses.dtype).eps) * jnp.concatenate(largest)[plan.order]
    diagonal = jnp.where(free, diagonal_of(plan, search.system.blocks), 0.0)
    change = dot(diagonal * two_ulp, two_ulp)
    return jnp.where(change < _RESOLVED * free.sum(axis=(0, 1), dtype=change.dtype), change, 0.0)
