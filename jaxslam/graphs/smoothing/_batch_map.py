"""The maximum a posteriori (MAP) path and landmarks of a log, a reference for accuracy."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core._record import record, static
from jaxslam.core.protocols import Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Log, Trace
from jaxslam.core.validation import InvalidField, at_least, or_none, positive
from jaxslam.graphs._chain.problem import Iterate, Iterations, Problem, optimize_chain
from jaxslam.graphs._solver.search import Ending
from jaxslam.graphs.smoothing._forward_pass import ForwardPass, LogEstimator, log_in_one_dtype
from jaxslam.graphs.smoothing._smoother import (
    chain_of,
    noise_roots,
    solution,
    start_of,
    with_singular,
)
from jaxslam.sensors._suite import of_robot


class BatchSolution(NamedTuple):
    """The `final` of the trace of `BatchMap`."""

    start: Float[Array, "R"]
    """pose before the first control, with the further numbers of the robot"""
    start_cov: Float[Array, "R R"]
    joint: Joint
    """the last pose and the map, a possible initial state of a filter"""
    regular: Bool[Array, ""]
    """the information on the map is positive definite; otherwise covariances are invalid"""
    filtered: Estimate
    """estimates of the filter that gave the initial path, with leading T"""
    start_noise: Float[Array, "R"]
    """ξ, the start's error in standard deviations: start = pose + P0^{1/2} ξ"""
    noise: Float[Array, "T W"]
    """η, the noises of the motions in standard deviations: w = Q^{1/2} η"""
    cost: Float[Array, ""]
    """½ Σ of the squared, whitened residuals"""
    costs: Float[Array, "iterations"]
    """cost after each step, the last one repeated; it falls where R is constant, and is infinite
    where not even the first step, to the smoother's path, has a finite cost"""
    iterations: Int[Array, ""]
    """steps made"""
    step: Float[Array, ""]
    """length of the next step, in posterior standard deviations"""
    ending: Int[Array, ""]
    """a `graphs.Ending`: converged, stalled or exhausted"""


@record
class BatchMap(LogEstimator):
    """The MAP estimator: Gauss-Newton on all poses and landmarks, minimizing the cost.

        ½ |x_0 ⊖ pose|²_{P0} + ½ Σ_t |w_t|²_{Q_t} + ½ Σ_{t,i} |z_ti ⊖ h(x_t, l_i)|²_{R_ti}
        with x_t = f(x_{t-1}, u_t, w_t)

    over x_0, w_1 … w_T and the landmarks, which have no prior. EKF-SLAM gives the initial path; its
    `Smoother` is the first step. Each further step linearizes the models along the newest path and
    solves for all unknowns (`eliminate`): a Gauss-Newton step is a smoother, and
    iterating the smoother is Gauss-Newton (Bell 1994, "The iterated Kalman smoother as a
    Gauss-Newton method", SIAM J. Optimization 4(3)). A step is shortened until the cost falls
    (Armijo). P0 and Q may be singular; O(T N²) a step. R is taken at the predictions of an
    iterate, and held while its step is computed and judged (`graphs.FromSensor`).

    It maps (log, key) to a `Trace`: estimates with leading T, the poses at the optimum
    with their covariances there (Laplace's), the map the same at every step; the infos of the
    filter, the last one `exhausted` where the batch did not converge, so that campaigns count it;
    and a `BatchSolution`. Every measurement is used that the filter fused or initialized a landmark
    with, except those of a singular R, whose status becomes `Status.SINGULAR`. Where Q depends on
    the pose, it is evaluated once at the filter's path.

    It is the graph of the log (`graphs.of_log`) with another solution: where the noises of a motion
    are three and not singular, `graphs.optimize` has the same optimum. Here a
    motion is a constraint, and the run itself associates the measurements; the
    sparse plan of `graphs.optimize` has to know that on the host.

    Raises ValueError as `LogEstimator`; on a sensor with K > 0, iterations below 1, or a tolerance
    that is not above 0.
    """

    _: dataclasses.KW_ONLY
    iterations: int = static(default=30, check=at_least(1))
    """largest number of steps"""
    tolerance: float | None = static(default=1e-6, check=or_none(positive))
    """end when the next step is below this many posterior standard deviations (the Newton
    decrement), or than √eps of the dtype, 3e-4 in float32, or where steps do not get shorter
    because of rounding. None runs all iterations in a loop of fixed length, which supports
    reverse-mode derivatives; they are those of the optimum if the search has converged"""

    def __post_init__(self) -> None:
        super().__post_init__()
        free = self.sensor.free.mean.shape[0]
        if free > 0:
            raise InvalidField(
                "sensor",
                f"expected one that measures all of a landmark, got {self.sensor.name}, which "
                f"leaves {free} of its parameters free",
            )

    def solve(self, log: Log, key: Array) -> Trace:
        motion, passed = self.motion, self._forward(log, key)
        sensor = of_robot(self.sensor, motion.state)
        log = log_in_one_dtype(log)
        kind = log.control.dtype
        mean, cov = jnp.asarray(self.pose, kind), jnp.asarray(self.pose_cov, kind)
        # The initial iterate is the filter's path, with its chain. The optimum does not depend on
        # it, so it has no derivative by it.
        initial = jax.lax.stop_gradient(passed)
        roots = noise_roots(motion, initial, log.control)
        chain, used = jax.lax.stop_gradient(chain_of(motion, sensor, initial, log, cov, roots))
        z = jnp.where(used[:, :, None], log.scan.z, 0.0)
        root = start_of(cov).root
        problem = Problem(mean, root, log.control, roots, z, chain.steps.slot, used)
        path = jnp.concatenate([mean[None], initial.corrected])
        landmarks = initial.trace.final.landmarks
        start = Iterate(chain.start.noise, chain.steps.noise, path, landmarks)
        search = optimize_chain(
            motion,
            sensor,
            problem,
            start,
            chain,
            passed.trace.final.alive,
            iterations=self.iterations,
            tolerance=self.tolerance,
        )
        estimate, solved = _at_end(sensor, search, passed)
        info = with_singular(passed.trace.info, problem.used)
        if self.tolerance is not None and info.exhausted is not None and len(info.exhausted):
            exhausted = info.exhausted.at[-1].max(search.ending != Ending.CONVERGED)
            info = info._replace(exhausted=exhausted)
        return Trace(estimate, info, solved, None)


def _at_end(
    sensor: Sensor, search: Iterations, passed: ForwardPass
) -> tuple[Estimate, BatchSolution]:
    """The estimates at the end of a search, and the `final` of the trace."""
    at, policy = search.at, search.policy
    joint = jax.lax.stop_gradient(passed.trace.final)._replace(landmarks=at.landmarks)
    # The last step computed is shorter than the tolerance, and is not made.
    no_step = policy._replace(
        start=policy.start._replace(constant=jnp.zeros_like(at.start)),
        steps=policy.steps._replace(constant=jnp.zeros_like(at.noise)),
        landmarks=jnp.zeros_like(at.landmarks),
    )
    # Gradients are finite where the decrement is zero, whose root has none.
    positive = policy.decrement > 0
    step = jnp.sqrt(jnp.where(positive, policy.decrement, 1.0))
    estimate, smoothed = solution(sensor, search.chain, no_step, at.path, joint, passed)
    solved = BatchSolution(
        *smoothed,
        start_noise=at.start,
        noise=at.noise,
        cost=search.cost,
        costs=search.costs,
        iterations=search.steps,
        step=jnp.where(positive, step, 0.0),
        ending=search.ending,
    )
    return estimate, solved
