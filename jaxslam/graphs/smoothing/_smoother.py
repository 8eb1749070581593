"""The fixed-interval smoother of EKF-SLAM: the marginal of each pose given the whole log.

It solves the chain of a forward pass: the models as linearized by the filter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.charts import Euclidean
from jaxslam.core._record import record
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Log, Status, Trace
from jaxslam.filters._ekf.map_coordinates import estimate_of
from jaxslam.graphs._chain.elimination import (
    Chain,
    LinearizedStep,
    Policy,
    Rows,
    Start,
    chain_marginals,
    eliminate,
    pose_difference,
    whitened_rows,
)
from jaxslam.graphs.smoothing._forward_pass import ForwardPass, LogEstimator, log_in_one_dtype
from jaxslam.linearize import _first_order as first_order
from jaxslam.math import _linalg as linalg
from jaxslam.math.angles import wrap
from jaxslam.sensors._suite import of_robot


def noise_roots(
    motion: Motion, passed: ForwardPass, control: Float[Array, "T U"]
) -> Float[Array, "T W W"]:
    """The square roots of the motions' noise covariances, at the filter's linearization points."""
    cov = jax.vmap(motion.noise_cov)(passed.before, control)
    return jax.vmap(linalg.root_psd)(cov)


def start_of(pose_cov: Float[Array, "R R"]) -> Start:
    """The start of a chain at the mean of the prior."""
    return Start(linalg.root_psd(pose_cov), jnp.zeros(len(pose_cov), pose_cov.dtype))


def chain_of(
    motion: Motion,
    sensor: Sensor,
    passed: ForwardPass,
    log: Log,
    pose_cov: Float[Array, "R R"],
    roots: Float[Array, "T W W"],
) -> tuple[Chain, Bool[Array, "T M"]]:
    """The filter's linear system about its path and final map, and which measurements it uses.

    The Kalman filter of this system is the EKF: its posterior of the last pose and the map is the
    filter's, its posterior of the poses before is the fixed-interval smoother's. A new landmark
    l = g(pose, z, s̄) + G_z v + G_s e is a measurement of itself and of the pose, without a prior.
    A measurement is used where the filter fused it or initialized a landmark with it, and its
    noise is regular.
    """

    def linearize_motion(
        before: Array, predicted: Array, corrected: Array, u: Array, root: Array
    ) -> tuple[Array, Array, Array]:
        by_pose, by_noise = first_order.motion_jacobians(motion, before, u)
        return by_pose, by_noise @ root, pose_difference(predicted, corrected)

    by_pose, by_noise, drift = jax.vmap(linearize_motion)(
        passed.before, passed.predicted, passed.corrected, log.control, roots
    )
    slot, a, b, r, used = _linearize_measurements(sensor, passed, log)
    noise = jnp.zeros((len(drift), len(motion.noises)), r.dtype)
    steps = LinearizedStep(by_pose, by_noise, drift, noise, slot, a, b, r)
    return Chain(start_of(pose_cov), steps), used


def _linearize_measurements(
    sensor: Sensor, passed: ForwardPass, log: Log
) -> tuple[Int[Array, "T M"], Array, Array, Array, Bool[Array, "T M"]]:
    """The slot of each measurement, A, B and b of `LinearizedStep`, and whether it is used."""
    size_l, size_z = len(sensor.landmark), len(sensor.measurements)
    info, final = passed.trace.info, passed.trace.final

    def pad(part: Array) -> Array:
        # A fused measurement has Z rows, a new landmark L.
        spare = max(size_l, size_z) - part.shape[0]
        return jnp.pad(part, [(0, spare)] + [(0, 0)] * (part.ndim - 1))

    def linearize_measurement(
        z: Array, slot: Array, fused: Array, new: Array, at: tuple[Array, ...]
    ) -> tuple[Array, Array, Array, Array]:
        predicted, predicted_map, corrected, corrected_map = at
        *parts, positive = whitened_rows(sensor, z, predicted, predicted_map[slot], fused)
        rows = [pad(part) for part in parts]
        pose, landmark = predicted, predicted_map[slot]
        if size_l > 0:
            *parts, regular = _new_landmark_rows(sensor, z, corrected)
            rows = [jnp.where(new, pad(part), row) for part, row in zip(parts, rows, strict=True)]
            positive = jnp.where(new, regular, positive)
            pose = jnp.where(new, corrected, pose)
            landmark = jnp.where(new, corrected_map[slot], landmark)
        use = (fused | new) & positive
        a, b, r = (jnp.where(use, row, jnp.zeros_like(row)) for row in rows)
        # From its linearization point to the reference.
        r = r - a @ pose_difference(corrected, pose) - b @ (final.landmarks[slot] - landmark)
        return a, b, r, use

    z = jnp.where(log.scan.valid[:, :, None], log.scan.z, 0.0)
    slot = jnp.maximum(info.slot, 0)
    fused, new = info.status == Status.FUSED, info.status == Status.BORN
    at = passed.predicted, passed.predicted_map, passed.corrected, passed.corrected_map
    over_slots = jax.vmap(linearize_measurement, (0, 0, 0, 0, None))
    return slot, *jax.vmap(over_slots)(z, slot, fused, new, at)


def _new_landmark_rows(sensor: Sensor, z: Float[Array, "Z"], pose: Float[Array, "R"]) -> Rows:
    """The rows of a new landmark: C^{-1/2} times -G_pose, I and 0, C = G_z R G_zᵀ + G_s S G_sᵀ."""
    size = len(sensor.landmark)
    mean, cov_s = (jnp.asarray(part, z.dtype) for part in sensor.free)
    by_pose, by_z, by_s = first_order.invert_jacobians(sensor, pose, z, mean)
    noise = by_z @ sensor.noise_cov(z) @ by_z.T + by_s @ cov_s @ by_s.T
    factor, positive = linalg.cholesky(noise)
    a = linalg.solve_lower(factor, -by_pose)
    b = linalg.solve_lower(factor, jnp.eye(size, dtype=z.dtype))
    return a, b, jnp.zeros(size, z.dtype), positive


class Smoothed(NamedTuple):
    """The `final` of a smoother's trace."""

    start: Float[Array, "R"]
    """pose before the first control, with the further numbers of the robot"""
    start_cov: Float[Array, "R R"]
    joint: Joint
    """the last pose and the map, a possible initial state of a filter"""
    regular: Bool[Array, ""]
    """the information on the map is positive definite; otherwise covariances are invalid"""
    filtered: Estimate
    """estimates of the filter, with leading T"""


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
        sensor = of_robot(self.sensor, self.motion.state)
        chain, used = chain_of(self.motion, sensor, passed, log, cov, roots)
        final = passed.trace.final
        policy = eliminate(chain, final.alive)
        path = jnp.concatenate([mean[None], passed.corrected])
        estimate, smoothed = solution(sensor, chain, policy, path, final, passed)
        return Trace(estimate, with_singular(passed.trace.info, used), smoothed, None)


def solution(
    sensor: Sensor,
    chain: Chain,
    policy: Policy,
    path: Float[Array, "poses R"],
    joint: Joint,
    passed: ForwardPass,
) -> tuple[Estimate, Smoothed]:
    """The estimates at the optimum of a chain about a path and the map of a joint."""
    deviation, covs, last_cov = chain_marginals(chain, policy)
    poses = path + deviation
    poses = poses.at[:, 2].set(wrap(poses[:, 2]))
    landmarks = jnp.where(joint.alive[:, None], joint.landmarks + policy.landmarks, 0.0)
    last = joint.with_robot(poses[-1])._replace(landmarks=landmarks, cov=last_cov)
    at_end = estimate_of(last, sensor, Euclidean())
    steps = path.shape[0] - 1
    always = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (steps, *leaf.shape)), at_end)
    if poses.shape[1] == 3:
        estimate = always._replace(pose=poses[1:], pose_cov=covs[1:])
    else:
        estimate = always._replace(
            pose=poses[1:, :3],
            pose_cov=covs[1:, :3, :3],
            further=poses[1:, 3:],
            further_cov=covs[1:, 3:, 3:],
        )
    filtered = passed.trace.estimate
    return estimate, Smoothed(poses[0], covs[0], last, policy.regular, filtered)


def with_singular(info: Info, used: Bool[Array, "T M"]) -> Info:
    """The filter's infos, with SINGULAR for measurements that the smoother cannot use; these have
    no landmark, distance or degrees of freedom."""
    in_filter = (info.status == Status.FUSED) | (info.status == Status.BORN)
    singular = in_filter & ~used
    return info._replace(
        status=jnp.where(singular, Status.SINGULAR, info.status).astype(info.status.dtype),
        slot=jnp.where(singular, -1, info.slot),
        nis=jnp.where(singular, 0.0, info.nis),
        dof=jnp.where(singular, 0, info.dof),
    )
