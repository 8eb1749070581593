"""Models and their Jacobians at separate linearization points, for first-order linearizers."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxslam.linearize import derivatives
from jaxslam.math.arrays import Control, Landmark, Measurement, Pose, PoseMatrix
from jaxslam.math.linalg import matmul
from jaxslam.protocols import Here, Motion, Sensor


def motion_at(
    motion: Motion, pose: Pose, u: Control, at: Pose
) -> tuple[Pose, PoseMatrix, PoseMatrix]:
    """The motion f(pose, u, 0), with ∂f/∂pose (3, 3) and W Q Wᵀ (3, 3) taken at another pose."""
    by_pose, by_noise = derivatives.motion_jacobians(motion, at, u)
    moved = motion.step(pose, u, jnp.zeros(by_noise.shape[1], pose.dtype))
    noise = motion.noise_cov(pose, u)
    return moved, by_pose, matmul(matmul(by_noise, noise), by_noise.T)


def observe_at(
    sensor: Sensor, here: Here, at_pose: Pose, at_landmark: Landmark
) -> tuple[Measurement, Float[Array, "Z 3"], Float[Array, "Z L"], Float[Array, "Z Z"]]:
    """The measurement h(pose, l), Jacobians at another pose and landmark, and no added noise."""
    by_pose, by_landmark = derivatives.observe_jacobians(sensor, at_pose, at_landmark)
    expected = sensor.observe(here.pose, here.landmark)
    return expected, by_pose, by_landmark, jnp.zeros((expected.shape[0],) * 2, expected.dtype)


def invert_at(
    sensor: Sensor, pose: Pose, z: Measurement, at_pose: Pose, at_z: Measurement
) -> tuple[Landmark, Float[Array, "L 3"], Float[Array, "L L"]]:
    """The landmark g(pose, z, s̄), ∂g/∂pose (L, 3) and its covariance; Jacobians at another pose.

    The covariance is G_z R G_zᵀ + G_s S G_sᵀ (L, L), with R at z: Solà (32)-(38), with the prior's
    term of (44).
    """
    mean, cov_s = (jnp.asarray(part, z.dtype) for part in sensor.free)
    by_pose, by_z, by_s = derivatives.invert_jacobians(sensor, at_pose, at_z, mean)
    own = by_z @ sensor.noise_cov(z) @ by_z.T + by_s @ cov_s @ by_s.T
    return sensor.invert(pose, z, mean), by_pose, own


def with_lever_arm(by_pose: Float[Array, "L 3"], offset: Float[Array, "2"]) -> Float[Array, "L 3"]:
    """The derivative of a point by the pose (·, 3), with an offset (2,) added to the lever arm."""
    return by_pose.at[:2, 2].add(jnp.stack([-offset[1], offset[0]]))
