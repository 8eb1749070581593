"""The nonlinear least-squares problem of a path and a map, and Gauss-Newton with line search on it.

The unknowns are the noises of the start and of the motions, in units of their standard
deviations, and the map; the path follows from the noises by the motion models. So the models hold
exactly at every iterate, and singular process noise is not a special case.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core.protocols import Motion, Sensor
from jaxslam.graphs._chain.elimination import (
    Chain,
    LinearizedStep,
    Policy,
    Start,
    eliminate,
    pose_difference,
    whitened_rows,
)
from jaxslam.graphs._solver.search import Ending
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math.angles import wrap


class Problem(NamedTuple):
    """The data of the problem: prior, controls and the measurements used."""

    pose: Float[Array, "R"]
    """mean of the start"""
    root: Float[Array, "R R"]
    """L, with L Lᵀ the covariance of the start"""
    control: Float[Array, "T U"]
    roots: Float[Array, "T W W"]
    """square roots of the noise covariances of the motions"""
    z: Float[Array, "T M Z"]
    slot: Int[Array, "T M"]
    used: Bool[Array, "T M"]


class Iterate(NamedTuple):
    """Values of all unknowns, and the resulting path."""

    start: Float[Array, "R"]
    """ξ"""
    noise: Float[Array, "T W"]
    """η"""
    path: Float[Array, "T+1 R"]
    """from the start on: x_0 = pose + L ξ, x_t = f(x_{t-1}, u_t, Q^{1/2} η_t)"""
    landmarks: Float[Array, "N L"]


def cost(sensor: Sensor, problem: Problem, at: Iterate, held: Iterate) -> Float[Array, ""]:
    """The cost ½ |ξ|² + ½ Σ |η_t|² + ½ Σ |R^{-1/2} (z ⊖ h(x_t, l))|² of an iterate.

    Minus the log posterior density, up to a constant, for fixed noise covariances: R is taken at
    the predictions of another iterate, `held`. A cost with R at its own predictions would fall
    where R grows, and so prefer long ranges.
    """

    def square(z: Array, slot: Array, used: Array, pose: Array, held_pose: Array) -> Array:
        z_hat = sensor.observe(held_pose, held.landmarks[slot])
        noise = predicted_noise(sensor, z_hat, z, used)
        residual = sensor.residual(z, sensor.observe(pose, at.landmarks[slot]))
        factor, positive = linalg.cholesky(noise)
        white = linalg.solve_lower(factor, residual)
        return jnp.where(used & positive, (white**2).sum(), 0.0)

    over_slots = jax.vmap(square, (0, 0, 0, None, None))
    data = problem.z, problem.slot, problem.used
    squares = jax.vmap(over_slots)(*data, at.path[1:], held.path[1:])
    return 0.5 * ((at.start**2).sum() + (at.noise**2).sum() + squares.sum())


def linearize_at(motion: Motion, sensor: Sensor, problem: Problem, at: Iterate) -> Chain:
    """The chain of the Gauss-Newton step: the models linearized at an iterate.

    It has as many rows a measurement as the chain of a filter (`smoothing._smoother.chain_of`).
    """
    spare = max(0, len(sensor.landmark) - len(sensor.measurements))

    def linearize_motion(pose: Array, u: Array, root: Array, noise: Array) -> tuple[Array, Array]:
        by_pose, by_noise = jax.jacfwd(motion.step, argnums=(0, 2))(pose, u, root @ noise)
        return by_pose, by_noise @ root

    by_pose, by_noise = jax.vmap(linearize_motion)(
        at.path[:-1], problem.control, problem.roots, at.noise
    )

    def linearize_measurement(
        z: Array, slot: Array, used: Array, pose: Array
    ) -> tuple[Array, Array, Array]:
        *rows, positive = whitened_rows(sensor, z, pose, at.landmarks[slot], used)
        rows = [jnp.where(used & positive, row, 0.0) for row in rows]
        a, b, r = (jnp.pad(row, [(0, spare)] + [(0, 0)] * (row.ndim - 1)) for row in rows)
        return a, b, r

    over_slots = jax.vmap(linearize_measurement, (0, 0, 0, None))
    a, b, r = jax.vmap(over_slots)(problem.z, problem.slot, problem.used, at.path[1:])
    no_drift = jnp.zeros_like(at.path[1:])
    steps = LinearizedStep(by_pose, by_noise, no_drift, at.noise, problem.slot, a, b, r)
    return Chain(Start(problem.root, at.start), steps)


def roll_out(
    motion: Motion, problem: Problem, at: Iterate, policy: Policy, share: Float[Array, ""]
) -> Iterate:
    """The iterate after a share of the step, by the nonlinear models.

    d_t = share k_t - J a_t - K δm with a_t = f(x_{t-1}, u_t, Q^{1/2} η̄_t) - x̄_t along the new
    path: later noises react to the nonlinear effect of earlier ones, as in differential dynamic
    programming (Jacobson & Mayne 1970). Otherwise a small early rotation would move the whole later
    path. To first order it is share times the Gauss-Newton step. The path of the initial iterate
    (x̄) need not satisfy the models; the path of the result does.
    """
    shift = share * policy.landmarks
    delta = shift.reshape(-1)
    start = at.start + share * policy.start.constant - policy.start.by_map @ delta
    first = problem.pose + problem.root @ start
    first = first.at[2].set(wrap(first[2]))

    def forward(pose: Array, row: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        u, root, noise, reference, constant, by_pose, by_map = row
        predicted = pose_difference(motion.step(pose, u, root @ noise), reference)
        noise = noise + share * constant - by_pose @ predicted - by_map @ delta
        pose = motion.step(pose, u, root @ noise)
        return pose, (pose, noise)

    gains = policy.steps
    data = problem.control, problem.roots, at.noise, at.path[1:]
    solved = gains.constant, gains.by_pose, gains.by_map
    _, (path, noise) = jax.lax.scan(forward, first, (*data, *solved))
    return Iterate(start, noise, jnp.concatenate([first[None], path]), at.landmarks + shift)


_SHARES = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.001)
"""Shares of the Gauss-Newton step, tried all at once; the first that lowers the cost is made."""

_ARMIJO = 1e-4
"""The least share of the decrease that the gradient predicts (Armijo); Nocedal and Wright 2006,
section 3.1, take this one."""

_IDLE = 0.8
"""A step whose decrement is above this share of the last one's does not get shorter."""

_RESOLVED = 0.01
"""The largest change of the cost by rounding that counts as such: a step of a tenth of a σ."""


class Iterations(NamedTuple):
    """The state of the iterations, and their result."""

    at: Iterate
    chain: Chain
    """about that iterate"""
    policy: Policy
    """the chain's solution"""
    cost: Float[Array, ""]
    """cost of the iterate, R at its own predictions"""
    costs: Float[Array, "iterations"]
    """cost after each step, the last one repeated"""
    steps: Int[Array, ""]
    """steps made"""
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
    """The result of the iterations from a start.

    chain: the chain of the first step, so that the start need not satisfy the models.

    Without tolerance all iterations are made, in a loop of fixed length. With one the search ends
    where it makes no step:

    | next step below the tolerance | steps left | a share lowers the cost | ending    |
    |-------------------------------|------------|-------------------------|-----------|
    | yes                           |            |                         | CONVERGED |
    | no                            | no         |                         | EXHAUSTED |
    | no                            | yes        | yes                     | goes on   |
    | no                            | yes        | no                      | STALLED   |

    EXHAUSTED and STALLED become CONVERGED where the decrease that the step promises is below the
    rounding of the cost.
    """

    def step(search: Iterations) -> tuple[Iterations, Bool[Array, ""]]:
        """The search after one iteration: solve the chain, then step or end. Whether it stepped."""
        policy = eliminate(search.chain, alive)
        converged = jnp.asarray(False)
        if tolerance is not None:
            # The next step is shorter than the tolerance, in posterior standard deviations. A step
            # of √eps is rounding of the gradient; so is one whose decrease of the cost is below
            # rounding and that is hardly shorter than the last. The first step is always made.
            eps = float(jnp.finfo(search.cost.dtype).eps)
            least = jnp.maximum(tolerance, eps**0.5)
            idle = policy.decrement > _IDLE * search.policy.decrement
            idle = idle & (policy.decrement <= eps * search.cost)
            converged = (search.steps > 0) & ((policy.decrement <= least**2) | idle)
        may_step = (search.steps < iterations) & ~converged
        after, lower = _line_search(motion, sensor, problem, search, policy)
        moved = may_step & lower
        chain = linearize_at(motion, sensor, problem, after)
        squares = [(part**2).sum() for part in (after.start, after.noise, chain.steps.residual)]
        trial = after, chain, 0.5 * linalg.total(squares)
        iterate = search.at, search.chain, search.cost
        at, chain, value = jax.tree.map(lambda a, b: jnp.where(moved, a, b), trial, iterate)
        ending = jnp.where(converged, Ending.CONVERGED, Ending.EXHAUSTED)
        ending = jnp.where(may_step & ~lower, Ending.STALLED, ending)
        if tolerance is not None:
            hidden = ~moved & (policy.decrement <= _rounding_of_cost(search))
            ending = jnp.where(hidden, Ending.CONVERGED, ending)
        later = jnp.arange(iterations, dtype=search.steps.dtype) >= search.steps
        after_step = Iterations(
            at=at,
            chain=chain,
            policy=policy,
            cost=value,
            costs=jnp.where(later, value, search.costs),
            steps=search.steps + moved.astype(search.steps.dtype),
            ending=ending.astype(jnp.int32),
        )
        return after_step, moved

    # Before the first step no chain is solved, and the cost is infinite.
    kind = chain.steps.residual.dtype
    unsolved = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(eliminate, chain, alive)
    )
    far, none = jnp.asarray(jnp.inf, kind), jnp.zeros((), jnp.int32)
    costs = jnp.full(iterations, jnp.inf, kind)
    begin = Iterations(start, chain, unsolved, far, costs, none, none + Ending.EXHAUSTED)
    # One iteration more than steps: the last solves the chain at the final iterate.
    if tolerance is None:
        fixed: Iterations = jax.lax.fori_loop(
            0, iterations + 1, lambda _, search: step(search)[0], begin
        )
        return fixed
    end: Iterations = jax.lax.while_loop(
        lambda carry: carry[1], lambda carry: step(carry[0]), (begin, jnp.asarray(True))
    )[0]
    return end


def _rounding_of_cost(search: Iterations) -> Float[Array, ""]:
    """The change of the cost by rounding of the coordinates, |r| |δr|, at most `_RESOLVED`.

    δr is the change of the residuals by two ulp of the largest coordinate of a position, and of π.
    """
    at, steps = search.at, search.chain.steps
    far = jnp.abs(jnp.concatenate([at.path[:, :2].ravel(), at.landmarks.ravel()])).max(initial=0.0)
    by_pose, by_map = jnp.abs(steps.pose_rows), jnp.abs(steps.landmark_rows)
    change = far * (by_pose[..., :2].sum(-1) + by_map.sum(-1)) + jnp.pi * by_pose[..., 2]
    change = 2 * float(jnp.finfo(search.cost.dtype).eps) * jnp.sqrt((change**2).sum())
    return jnp.minimum(jnp.sqrt(2 * search.cost) * change, _RESOLVED)


def _line_search(
    motion: Motion, sensor: Sensor, problem: Problem, search: Iterations, policy: Policy
) -> tuple[Iterate, Bool[Array, ""]]:
    """The iterate at the first share of the step that lowers the cost enough, R held, and whether
    there is such a share. The first step may raise the cost, as long as it is finite."""
    kind = search.cost.dtype
    shares, eps = jnp.asarray(_SHARES, kind), float(jnp.finfo(kind).eps)
    tried = jax.vmap(lambda share: roll_out(motion, problem, search.at, policy, share))(shares)
    costs = jax.vmap(lambda at: cost(sensor, problem, at, search.at))(tried)
    # To first order a step lowers the cost by share · λ²; the margin is the rounding of sums.
    first = search.steps == 0
    before = jnp.where(first, 0.0, search.cost)  # of the first step infinite
    enough = before * (1 + 10 * eps) - _ARMIJO * shares * policy.decrement
    good = jnp.isfinite(costs) & (first | (costs <= enough))
    chosen = jnp.argmax(good)
    after: Iterate = jax.tree.map(lambda leaf: leaf[chosen], tried)
    return after, good.any()
