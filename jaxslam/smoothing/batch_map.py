"""The maximum a posteriori path and map of a log: the yardstick of accuracy."""

import math
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxslam.math.linalg import check_count, is_concrete
from jaxslam.protocols import Associate, Estimator, Motion, Sensor
from jaxslam.slots import Joint
from jaxslam.smoothing import history as forward
from jaxslam.smoothing.chain import Chain, Policy, eliminate
from jaxslam.smoothing.descent import Point, Problem, cost, linearized, rolled_out
from jaxslam.smoothing.smooth import counted, in_one_width, solution
from jaxslam.types import Estimate, Log, Trace

Array = jax.Array

_SHARES = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.001)
"""of the Gauss-Newton step that are tried, all at once; the first that lowers the cost is taken."""

_ARMIJO = 1e-4
"""of the decrease that the slope promises, which the cost must make good."""


class Ending(IntEnum):
    """Why the iterations ended."""

    CONVERGED = 0
    """The next step is shorter than the tolerance, or rounding."""
    EXHAUSTED = 1
    """All iterations were made."""
    STALLED = 2
    """No share of the step lowers the cost: rounding, or a model whose derivatives are wrong."""


class Solved(NamedTuple):
    """The `final` of the trace of `batch_map`."""

    start: Array
    """(3,) pose before the first control"""
    start_cov: Array
    """(3, 3)"""
    joint: Joint
    """the last pose and the map, which a filter may go on from"""
    regular: Array
    """() bool: the information on the map is positive definite; else covariances mean nothing"""
    filtered: Estimate
    """with leading T, of the filter that went first"""
    start_noise: Array
    """(3,) ξ, the start's error in standard deviations: start = pose + P0^{1/2} ξ"""
    noise: Array
    """(T, W) η, the same of the motions: w = Q^{1/2} η"""
    cost: Array
    """() ½ Σ of the squared, whitened residuals"""
    costs: Array
    """(iterations,) after each step, that of the last repeated; infinite where not even the first,
    to the smoother's path, has a finite cost"""
    iterations: Array
    """() int, steps taken"""
    step: Array
    """() length of the next step, in posterior standard deviations"""
    ending: Array
    """() int, see `Ending`"""


class _Search(NamedTuple):
    point: Point
    chain: Chain
    """about the point"""
    policy: Policy
    """the chain's"""
    cost: Array
    costs: Array
    taken: Array
    ending: Array
    """EXHAUSTED while it goes on"""


def batch_map(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    pose: ArrayLike,
    pose_cov: ArrayLike,
    *,
    iterations: int = 30,
    tolerance: float | None = 1e-6,
    associate: Associate | None = None,
    gate: float | None = None,
    births: int | None = None,
) -> Estimator:
    """Gauss-Newton on all poses and landmarks at once: the least of `descent.cost`.

        ½ |x_0 ⊖ pose|²_{P0} + ½ Σ_t |w_t|²_{Q_t} + ½ Σ_{t,i} |z_ti ⊖ h(x_t, l_i)|²_{R_ti}
        with x_t = f(x_{t-1}, u_t, w_t)

    over x_0, w_1 … w_T and the landmarks, which have no prior. An EKF-SLAM goes first; its smoother
    (`smooth`) is the first step. Each further one linearizes the same models along the newest path
    and solves for all unknowns exactly (`chain.eliminate`): a Gauss-Newton step is a smoother, and
    iterating the smoother is Gauss-Newton (Bell 1994, "The iterated Kalman smoother as a
    Gauss-Newton method", SIAM J. Optimization 4(3)). A step is shortened until the cost falls
    (Armijo). P0 and Q may be singular; O(T N²) a step.

    What it returns maps (log, key) to a `Trace`: estimates with leading T, the poses at the optimum
    with their covariances there (Laplace's), the map the same at every step; the infos of the
    filter that went first, the last one `exhausted` where the batch did not converge, so that
    campaigns count it; and a `Solved`. Every measurement is used that the filter fused or
    started a landmark with, but those of a singular R, whose status becomes `Status.SINGULAR`.
    Where Q depends on the pose, it is taken where the filter was, and stays.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`. The sensor must see all of a
            landmark (K = 0), or be an absolute one.
        capacity: landmark slots N.
        pose, pose_cov: (3,) and (3, 3) where the robot is before the first control.
        iterations: at most so many steps.
        tolerance: end when the next step is shorter than so many posterior standard deviations
            (the Newton decrement), or than √eps of the dtype, 3e-4 in float32, or where rounding
            lets steps grow no shorter. None makes all iterations in a loop of fixed length, which
            reverse-mode derivatives can go through; they are those of the optimum as far as the
            search has converged.
        associate, gate, births: of the filter that goes first, as for `ekf_slam`.
    Raises:
        ValueError: as `smooth` does; on a sensor with K > 0, iterations below 1, or a tolerance
            that is not above 0.
    """
    check_count("batch_map: iterations", iterations)
    if tolerance is not None and is_concrete(tolerance) and not 0 < tolerance < math.inf:
        raise ValueError(f"batch_map: expected a tolerance above 0, got {tolerance}")
    filter = forward.filter_of(
        motion, sensor, capacity, name="batch_map", associate=associate, gate=gate, births=births
    )
    if sensor.free.mean.shape[0] > 0:
        raise ValueError(
            f"batch_map: expected a sensor that sees all of a landmark, and {sensor.name} leaves "
            f"{sensor.free.mean.shape[0]} of its parameters free"
        )

    def solve(log: Log, key: Array) -> Trace:
        history = forward.filtered(filter, log, pose, pose_cov, key)
        log = in_one_width(log)
        kind = log.control.dtype
        begin, cov = jnp.asarray(pose, kind), jnp.asarray(pose_cov, kind)
        # The optimum does not depend on where the search begins, so no derivative goes there.
        start = jax.lax.stop_gradient(history)
        roots = forward.roots_of(motion, start, log.control)
        chain, used = jax.lax.stop_gradient(
            forward.chain_of(motion, sensor, start, log, cov, roots)
        )
        final = start.trace.final
        problem = Problem(
            begin,
            forward.start_of(cov).root,
            log.control,
            roots,
            jnp.where(used[:, :, None], log.scan.z, 0.0),
            chain.steps.slot,
            used,
        )
        path = jnp.concatenate([begin[None], start.after])
        at = Point(chain.start.noise, chain.steps.noise, path, final.landmarks)
        search = _descend(
            motion,
            sensor,
            problem,
            at,
            chain,
            final.alive,
            iterations=iterations,
            tolerance=tolerance,
        )
        point, policy = search.point, search.policy
        best = final._replace(landmarks=point.landmarks)
        # The step that is left is shorter than the tolerance, and is not taken.
        still = policy._replace(
            start=policy.start._replace(constant=jnp.zeros_like(point.start)),
            steps=policy.steps._replace(constant=jnp.zeros_like(point.noise)),
            landmarks=jnp.zeros_like(point.landmarks),
        )
        left = policy.decrement > 0
        step = jnp.sqrt(jnp.where(left, policy.decrement, 1.0))
        estimate, found = solution(sensor, search.chain, still, point.path, best)
        solved = Solved(
            *found,
            history.trace.estimate,
            start_noise=point.start,
            noise=point.noise,
            cost=search.cost,
            costs=search.costs,
            iterations=search.taken,
            step=jnp.where(left, step, 0.0),
            ending=search.ending,
        )
        info = counted(history.trace.info, used)
        if tolerance is not None and info.exhausted.shape[0] > 0:
            cut_short = info.exhausted.at[-1].max(search.ending != Ending.CONVERGED)
            info = info._replace(exhausted=cut_short)
        return Trace(estimate, info, solved, None)

    return forward.compiled_once(filter, pose, pose_cov, solve)


def _descend(
    motion: Motion,
    sensor: Sensor,
    problem: Problem,
    point: Point,
    chain: Chain,
    alive: Array,
    *,
    iterations: int,
    tolerance: float | None,
) -> _Search:
    """Steps from a point, whose path need not obey the models; the first is by the chain given."""
    kind = problem.z.dtype
    shares = jnp.asarray(_SHARES, kind)
    eps = float(jnp.finfo(kind).eps)

    def body(search: _Search) -> tuple[_Search, Array]:
        """Solve the chain; end there, or step and make the next."""
        policy = eliminate(search.chain, alive)
        first = search.taken == 0
        may = search.taken < iterations
        ending = jnp.asarray(Ending.EXHAUSTED, jnp.int32)
        if tolerance is not None:
            # A step of √eps is rounding of the gradient; so is one that the cost cannot tell and
            # that is hardly shorter than the last.
            least_step = jnp.maximum(tolerance, eps**0.5)
            idle = policy.decrement > 0.8 * search.policy.decrement
            idle = idle & (policy.decrement <= eps * search.cost)
            near = ~first & ((policy.decrement <= least_step**2) | idle)
            may, ending = may & ~near, jnp.where(near, Ending.CONVERGED, ending)
        tried = jax.vmap(lambda share: rolled_out(motion, problem, search.point, policy, share))(
            shares
        )
        costs = jax.vmap(lambda point: cost(sensor, problem, point))(tried)
        # To first order, share · λ² is what a step lowers the cost by; beyond the rounding of sums.
        known = jnp.where(first, 0.0, search.cost)
        enough = known * (1 + 10 * eps) - _ARMIJO * shares * policy.decrement
        good = jnp.isfinite(costs) & (first | (costs <= enough))
        chosen = jnp.argmax(good)
        ending = jnp.where(may & ~good.any(), Ending.STALLED, ending)
        moved = may & good.any()
        after: Point = jax.tree.map(lambda leaf: leaf[chosen], tried)
        there = after, linearized(motion, sensor, problem, after), costs[chosen]
        here = search.point, search.chain, search.cost
        point, chain, value = jax.tree.map(lambda a, b: jnp.where(moved, a, b), there, here)
        late = jnp.arange(iterations) >= search.taken
        after_it = _Search(
            point=point,
            chain=chain,
            policy=policy,
            cost=value,
            costs=jnp.where(late, value, search.costs),
            taken=search.taken + moved,
            ending=jnp.where(moved, Ending.EXHAUSTED, ending).astype(jnp.int32),
        )
        return after_it, moved

    far = jnp.asarray(jnp.inf, kind)
    nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(eliminate, chain, alive)
    )
    costs, none = jnp.full(iterations, jnp.inf, kind), jnp.zeros((), jnp.int32)
    begin = _Search(point, chain, nothing, far, costs, none, none + Ending.EXHAUSTED)
    # Once more than there are steps: the last time to solve where the last step led.
    if tolerance is None:
        fixed: _Search = jax.lax.fori_loop(
            0, iterations + 1, lambda _, search: body(search)[0], begin
        )
        return fixed
    out: tuple[_Search, Array] = jax.lax.while_loop(
        lambda carry: carry[1], lambda carry: body(carry[0]), (begin, jnp.asarray(True))
    )
    return out[0]
