"""The fixed-interval smoother of EKF-SLAM: the marginal of each pose given the whole log."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.charts import Euclidean
from jaxslam.core.record import record
from jaxslam.filters.ekf.map_coordinates import estimate_of
from jaxslam.graphs.chain.elimination import Chain, Policy, chain_marginals, eliminate
from jaxslam.math.angles import wrap
from jaxslam.protocols import Sensor
from jaxslam.slots import Joint
from jaxslam.smoothing.forward_pass import (
    ForwardPass,
    LogEstimator,
    log_in_one_dtype,
)
from jaxslam.smoothing.linearization import chain_of, noise_roots
from jaxslam.types import Estimate, Info, Log, Status, Trace


class Smoothed(NamedTuple):
    """The `final` of a smoother's trace."""

    start: Float[Array, "3"]
    """pose before the first control"""
    start_cov: Float[Array, "3 3"]
    joint: Joint
    """the last pose and the map, a possible initial state of a filter"""
    regular: Bool[Array, ""]
    """the information on the map is positive definite; else covariances are invalid"""
    filtered: Estimate
    """with leading T, of the filter"""


@record
class Smoother(LogEstimator):
    """The Rauch-Tung-Striebel smoother of `EkfSlam(correction="joint")`, without D×D matrices.

    p(x_t | all scans) of the linear system of the EKF: the Jacobians are those of the filter, so
    the last pose and the map equal the filter's, to rounding, and every earlier pose uses the later
    scans. The recursion of Rauch, Tung & Striebel 1965 ("Maximum likelihood estimates of linear
    dynamic systems", AIAA Journal 3(8)) would store T covariances of the map and invert each, where
    landmarks may not be initialized yet and the noise of a motion may be singular;
    `eliminate` gives the same numbers from the Jacobians alone, O(T N²). A landmark has no
    prior: its initialization is a measurement of it.

    It maps (log, key) to a `Trace`: estimates with leading T, the poses smoothed and
    the final map at every step; the filter's infos, in which measurements of singular noise, which
    the smoother cannot use, become `Status.SINGULAR`; and a `Smoothed`.

        estimator = Smoother(world.motion, world.sensor, 20, world.pose, world.pose_cov)
        trace = estimator(log, jax.random.key(0))

    Raises ValueError as `LogEstimator`.
    """

    def solve(self, log: Log, key: Array) -> Trace:
        passed = self._forward(log, key)
        log = log_in_one_dtype(log)
        kind = log.control.dtype
        mean, cov = jnp.asarray(self.pose, kind), jnp.asarray(self.pose_cov, kind)
        roots = noise_roots(self.motion, passed, log.control)
        chain, used = chain_of(self.motion, self.sensor, passed, log, cov, roots)
        final = passed.trace.final
        policy = eliminate(chain, final.alive)
        path = jnp.concatenate([mean[None], passed.corrected])
        estimate, smoothed = solution(self.sensor, chain, policy, path, final, passed)
        return Trace(estimate, with_singular(passed.trace.info, used), smoothed, None)


def solution(
    sensor: Sensor,
    chain: Chain,
    policy: Policy,
    path: Float[Array, "poses 3"],
    joint: Joint,
    passed: ForwardPass,
) -> tuple[Estimate, Smoothed]:
    """The estimates at the optimum of a chain about a path and the map of a joint."""
    found = chain_marginals(chain, policy)
    poses = path + found.path
    poses = poses.at[:, 2].set(wrap(poses[:, 2]))
    landmarks = jnp.where(joint.alive[:, None], joint.landmarks + policy.landmarks, 0.0)
    last = joint._replace(pose=poses[-1], landmarks=landmarks, cov=found.cov)
    at_end = estimate_of(last, sensor, Euclidean())
    steps = path.shape[0] - 1
    always = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (steps, *leaf.shape)), at_end)
    estimate = always._replace(pose=poses[1:], pose_cov=found.covs[1:])
    filtered = passed.trace.estimate
    return estimate, Smoothed(poses[0], found.covs[0], last, policy.regular, filtered)


def with_singular(info: Info, used: Bool[Array, "T M"]) -> Info:
    """The filter's infos, with SINGULAR for measurements that the smoother cannot use: they have no
    landmark, distance or degrees of freedom."""
    taken = (info.status == Status.FUSED) | (info.status == Status.BORN)
    singular = taken & ~used
    return info._replace(
        status=jnp.where(singular, Status.SINGULAR, info.status).astype(info.status.dtype),
        slot=jnp.where(singular, -1, info.slot),
        nis=jnp.where(singular, 0.0, info.nis),
        dof=jnp.where(singular, 0, info.dof),
    )
