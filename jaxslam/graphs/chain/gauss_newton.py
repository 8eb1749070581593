"""Gauss-Newton with line search on the problem of a path and a map."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs.chain.elimination import Chain, Policy, eliminate
from jaxslam.graphs.chain.problem import Iterate, Problem, cost, linearize_at, roll_out
from jaxslam.graphs.solver.search import Ending
from jaxslam.protocols import Motion, Sensor

_SHARES = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.001)
"""of the Gauss-Newton step that are tried, all at once; the first that lowers the cost is taken."""

_ARMIJO = 1e-4
"""least share of the decrease predicted by the gradient (Armijo)."""


class Iterations(NamedTuple):
    """The state of the iterations, and their result."""

    at: Iterate
    chain: Chain
    """about that iterate"""
    policy: Policy
    """the chain's solution"""
    cost: Float[Array, ""]
    costs: Float[Array, "iterations"]
    """after each step, that of the last repeated"""
    taken: Int[Array, ""]
    """steps"""
    ending: Int[Array, ""]
    """EXHAUSTED while the iterations continue"""


def optimize_chain(
    motion: Motion,
    sensor: Sensor,
    problem: Problem,
    start: Iterate,
    chain: Chain,
    alive: Bool[Array, "N"],
    *,
    iterations: int,
    tolerance: float | None,
) -> Iterations:
    """The result of the iterations from a start; the first step is by the given chain, so the start
    need not satisfy the models.

    Without tolerance all iterations are made, in a loop of fixed length.
    """

    def step(search: Iterations) -> tuple[Iterations, Bool[Array, ""]]:
        """The search after one iteration: solve the chain, then step or end. Whether it stepped."""
        policy = eliminate(search.chain, alive)
        converged = jnp.asarray(False)
        if tolerance is not None:
            converged = _converged(search, policy, tolerance)
        may = (search.taken < iterations) & ~converged
        after, value, lower = _line_search(motion, sensor, problem, search, policy)
        moved = may & lower
        there = after, linearize_at(motion, sensor, problem, after), value
        here = search.at, search.chain, search.cost
        at, chain, value = jax.tree.map(lambda a, b: jnp.where(moved, a, b), there, here)
        ending = jnp.where(converged, Ending.CONVERGED, Ending.EXHAUSTED)
        ending = jnp.where(may & ~lower, Ending.STALLED, ending)
        late = jnp.arange(iterations) >= search.taken
        found = Iterations(
            at=at,
            chain=chain,
            policy=policy,
            cost=value,
            costs=jnp.where(late, value, search.costs),
            taken=search.taken + moved,
            ending=ending.astype(jnp.int32),
        )
        return found, moved

    begin = _unstarted(start, chain, alive, iterations)
    # One iteration more than steps: the last solves the chain at the final iterate.
    if tolerance is None:
        fixed: Iterations = jax.lax.fori_loop(
            0, iterations + 1, lambda _, search: step(search)[0], begin
        )
        return fixed
    out: tuple[Iterations, Array] = jax.lax.while_loop(
        lambda carry: carry[1], lambda carry: step(carry[0]), (begin, jnp.asarray(True))
    )
    return out[0]


def _unstarted(
    start: Iterate, chain: Chain, alive: Bool[Array, "N"], iterations: int
) -> Iterations:
    """The search before the first step: no chain solved, and infinite cost."""
    kind = chain.steps.residual.dtype
    unsolved = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(eliminate, chain, alive)
    )
    far, none = jnp.asarray(jnp.inf, kind), jnp.zeros((), jnp.int32)
    costs = jnp.full(iterations, jnp.inf, kind)
    return Iterations(start, chain, unsolved, far, costs, none, none + Ending.EXHAUSTED)


def _converged(search: Iterations, policy: Policy, tolerance: float) -> Bool[Array, ""]:
    """Whether the next step is shorter than the tolerance, in posterior standard deviations.

    A step of √eps is rounding of the gradient; so is one whose decrease of the cost is below
    rounding and that is hardly shorter than the last. The first step is always made.
    """
    eps = float(jnp.finfo(search.cost.dtype).eps)
    least = jnp.maximum(tolerance, eps**0.5)
    idle = policy.decrement > 0.8 * search.policy.decrement
    idle = idle & (policy.decrement <= eps * search.cost)
    return (search.taken > 0) & ((policy.decrement <= least**2) | idle)


def _line_search(
    motion: Motion, sensor: Sensor, problem: Problem, search: Iterations, policy: Policy
) -> tuple[Iterate, Float[Array, ""], Bool[Array, ""]]:
    """The iterate at the first share of the step that lowers the cost enough, its cost, and whether
    there is such a share. The first step may raise the cost, if it stays finite."""
    kind = search.cost.dtype
    shares, eps = jnp.asarray(_SHARES, kind), float(jnp.finfo(kind).eps)
    tried = jax.vmap(lambda share: roll_out(motion, problem, search.at, policy, share))(shares)
    costs = jax.vmap(lambda at: cost(sensor, problem, at))(tried)
    # To first order a step lowers the cost by share · λ²; the margin is the rounding of sums.
    first = search.taken == 0
    known = jnp.where(first, 0.0, search.cost)
    enough = known * (1 + 10 * eps) - _ARMIJO * shares * policy.decrement
    good = jnp.isfinite(costs) & (first | (costs <= enough))
    chosen = jnp.argmax(good)
    after: Iterate = jax.tree.map(lambda leaf: leaf[chosen], tried)
    return after, costs[chosen], good.any()
