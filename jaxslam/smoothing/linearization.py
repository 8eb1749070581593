"""The chain of a forward pass: the models as linearized by the filter."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.graphs.chain.elimination import (
    Chain,
    LinearizedStep,
    Rows,
    Start,
    pose_difference,
    whitened_rows,
)
from jaxslam.linearize import first_order
from jaxslam.math import linalg
from jaxslam.protocols import Motion, Sensor
from jaxslam.smoothing.forward_pass import ForwardPass
from jaxslam.types import Log, Status


def noise_roots(
    motion: Motion, passed: ForwardPass, control: Float[Array, "T U"]
) -> Float[Array, "T W W"]:
    """The square roots of the motions' noise covariances, at the filter's linearization points."""
    cov = jax.vmap(motion.noise_cov)(passed.before, control)
    return jax.vmap(linalg.root_psd)(cov)


def start_of(pose_cov: Float[Array, "3 3"]) -> Start:
    """The start of a chain at the mean of the prior."""
    return Start(linalg.root_psd(pose_cov), jnp.zeros(3, pose_cov.dtype))


def chain_of(
    motion: Motion,
    sensor: Sensor,
    passed: ForwardPass,
    log: Log,
    pose_cov: Float[Array, "3 3"],
    roots: Float[Array, "T W W"],
) -> tuple[Chain, Bool[Array, "T M"]]:
    """The filter's linear system about its path and final map, and which measurements it uses.

    The Kalman filter of this system is the EKF: its posterior of the last pose and the map is the
    filter's, its posterior of the poses before is the fixed-interval smoother's. A new landmark
    l = g(pose, z, s̄) + G_z v + G_s e is a measurement of itself and of the pose, without a prior.
    A measurement is used where the filter fused it or initialized a landmark with it, and its
    noise is regular.
    """
    by_pose, by_noise, drift = _motions(motion, passed, log.control, roots)
    slot, a, b, r, used = _measurements(sensor, passed, log)
    noise = jnp.zeros((len(drift), len(motion.noises)), r.dtype)
    steps = LinearizedStep(by_pose, by_noise, drift, noise, slot, a, b, r)
    return Chain(start_of(pose_cov), steps), used


def _motions(
    motion: Motion, passed: ForwardPass, control: Float[Array, "T U"], roots: Float[Array, "T W W"]
) -> tuple[Float[Array, "T 3 3"], Float[Array, "T 3 W"], Float[Array, "T 3"]]:
    """The matrices F, G and the offset c of `LinearizedStep` for each motion."""

    def one(
        before: Array, predicted: Array, corrected: Array, u: Array, root: Array
    ) -> tuple[Array, Array, Array]:
        by_pose, by_noise = first_order.motion_jacobians(motion, before, u)
        return by_pose, by_noise @ root, pose_difference(predicted, corrected)

    return jax.vmap(one)(passed.before, passed.predicted, passed.corrected, control, roots)


def _measurements(
    sensor: Sensor, passed: ForwardPass, log: Log
) -> tuple[Int[Array, "T M"], Array, Array, Array, Bool[Array, "T M"]]:
    """The slot of each measurement, A, B and b of `LinearizedStep`, and whether it is used."""
    size_l, size_z = len(sensor.landmark), len(sensor.measurements)
    info, final = passed.trace.info, passed.trace.final

    def padded(part: Array) -> Array:
        spare = max(size_l, size_z) - part.shape[0]
        return jnp.pad(part, [(0, spare)] + [(0, 0)] * (part.ndim - 1))

    def one(
        z: Array, slot: Array, fused: Array, new: Array, at: tuple[Array, ...]
    ) -> tuple[Array, Array, Array, Array]:
        predicted, predicted_map, corrected, corrected_map = at
        *parts, positive = whitened_rows(sensor, z, predicted, predicted_map[slot])
        rows = [padded(part) for part in parts]
        pose, landmark = predicted, predicted_map[slot]
        if size_l > 0:
            *parts, regular = _new_landmark_rows(sensor, z, corrected)
            rows = [
                jnp.where(new, padded(part), row) for part, row in zip(parts, rows, strict=True)
            ]
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
    over_slots = jax.vmap(one, (0, 0, 0, 0, None))
    return slot, *jax.vmap(over_slots)(z, slot, fused, new, at)


def _new_landmark_rows(sensor: Sensor, z: Float[Array, "Z"], pose: Float[Array, "3"]) -> Rows:
    """The rows of a new landmark: C^{-1/2} times -G_pose, I and 0, C = G_z R G_zᵀ + G_s S G_sᵀ."""
    size = len(sensor.landmark)
    mean, cov_s = (jnp.asarray(part, z.dtype) for part in sensor.free)
    by_pose, by_z, by_s = first_order.invert_jacobians(sensor, pose, z, mean)
    own = by_z @ sensor.noise_cov(z) @ by_z.T + by_s @ cov_s @ by_s.T
    factor, positive = linalg.cholesky(own)
    a = linalg.solve_lower(factor, -by_pose)
    b = linalg.solve_lower(factor, jnp.eye(size, dtype=z.dtype))
    return a, b, jnp.zeros(size, z.dtype), positive
