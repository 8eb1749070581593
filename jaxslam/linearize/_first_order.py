"""Jacobians at the current estimate, and at other linearization points: the standard EKF.

They are taken by forward-mode automatic differentiation. The hand-derived Jacobians of models are
for verification; filters do not use them, so a user's model needs none.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxslam.core._record import record
from jaxslam.core.protocols import LinearizationPoint, Linearizer, Motion, Sensor
from jaxslam.math._arrays import (
    Control,
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Robot,
    RobotMatrix,
    Unmeasured,
)
from jaxslam.math._linalg import matmul


def motion_jacobians(
    motion: Motion, pose: Robot, u: Control
) -> tuple[RobotMatrix, Float[Array, "R W"]]:
    """The Jacobians F, W of a motion, ∂step/∂pose and ∂step/∂w at w = 0 (Solà (13))."""
    w = jnp.zeros(len(motion.noises), pose.dtype)
    by_pose, by_noise = jax.jacfwd(motion.step, argnums=(0, 2))(pose, u, w)
    return by_pose, by_noise


@partial(jax.jit, inline=True)
def nominal_path(
    motion: Motion, start: Robot, controls: Float[Array, "T U"]
) -> Float[Array, "T R"]:
    """The path x_t = f(x_{t-1}, u_t, 0) of the odometry alone, without its start."""
    still = jnp.zeros(len(motion.noises), controls.dtype)

    def step(pose: Array, u: Array) -> tuple[Array, Array]:
        pose = motion.step(pose, u, still)
        return pose, pose

    path: Array = jax.lax.scan(step, start, controls)[1]
    return path


def observe_jacobians(sensor: Sensor, pose: Robot, landmark: Landmark) -> ObserveJacobians:
    """The Jacobians H of a measurement, ∂observe/∂pose and ∂observe/∂l (Solà (25))."""
    by_pose, by_landmark = jax.jacfwd(sensor.observe, argnums=(0, 1))(pose, landmark)
    return by_pose, by_landmark


def invert_jacobians(sensor: Sensor, pose: Robot, z: Measurement, s: Unmeasured) -> InvertJacobians:
    """The Jacobians G of a new landmark by pose, z and s, ∂invert/∂… (Solà (41)-(43))."""
    by_pose, by_z, by_s = jax.jacfwd(sensor.invert, argnums=(0, 1, 2))(pose, z, s)
    return by_pose, by_z, by_s


def predicted_noise(
    sensor: Sensor, z_hat: Measurement, z: Measurement, has_prediction: Bool[Array, ""]
) -> Float[Array, "Z Z"]:
    """The measurement noise R(ẑ), and R(z) where there is no prediction.

    N(z; ẑ, H P Hᵀ + R(z)) is no density of z: where σ grows with the range, a range that came out
    short is trusted too much, the estimate is biased, and NIS exceeds its degrees of freedom. R(ẑ)
    does not depend on the noise of z.
    """
    cov: Array = sensor.noise_cov(jnp.where(has_prediction, z_hat, z))
    return cov


def motion_at(
    motion: Motion, pose: Robot, u: Control, at: Robot
) -> tuple[Robot, RobotMatrix, RobotMatrix]:
    """The motion f(pose, u, 0), with ∂f/∂pose (R, R) and W Q Wᵀ (R, R) taken at another pose."""
    by_pose, by_noise = motion_jacobians(motion, at, u)
    moved = motion.step(pose, u, jnp.zeros(by_noise.shape[1], pose.dtype))
    # Q is taken at the estimate, also where F and W are taken at another pose.
    noise = motion.noise_cov(pose, u)
    return moved, by_pose, matmul(matmul(by_noise, noise), by_noise.T)


def observe_at(
    sensor: Sensor, point: LinearizationPoint, at_pose: Robot, at_landmark: Landmark
) -> tuple[Measurement, Float[Array, "Z R"], Float[Array, "Z L"], Float[Array, "Z Z"]]:
    """The measurement h(pose, l), Jacobians at another pose and landmark, and no added noise."""
    by_pose, by_landmark = observe_jacobians(sensor, at_pose, at_landmark)
    expected = sensor.observe(point.pose, point.landmark)
    return expected, by_pose, by_landmark, jnp.zeros((expected.shape[0],) * 2, expected.dtype)


def invert_at(
    sensor: Sensor, pose: Robot, z: Measurement, at_pose: Robot, at_z: Measurement
) -> tuple[Landmark, Float[Array, "L R"], Float[Array, "L L"]]:
    """The landmark g(pose, z, s̄), ∂g/∂pose (L, R) and its covariance; Jacobians at another pose.

    The covariance is G_z R G_zᵀ + G_s S G_sᵀ (L, L), with R at z: Solà (32)-(38), with the prior's
    term of (44).
    """
    mean, cov_s = (jnp.asarray(part, z.dtype) for part in sensor.free)
    by_pose, by_z, by_s = invert_jacobians(sensor, at_pose, at_z, mean)
    # R at z, as there is no prediction of a new landmark.
    cov = by_z @ sensor.noise_cov(z) @ by_z.T + by_s @ cov_s @ by_s.T
    return sensor.invert(pose, z, mean), by_pose, cov


def with_lever_arm(by_pose: Float[Array, "L R"], offset: Float[Array, "2"]) -> Float[Array, "L R"]:
    """The derivative of a point by the pose (·, 3), with an offset (2,) added to the lever arm."""
    # ∂(R a)/∂θ = J R a, J = [0, -1; 1, 0]: linear in the arm.
    return by_pose.at[:2, 2].add(jnp.stack([-offset[1], offset[0]]))


@record
class AtEstimate(Linearizer):
    """The EKF linearizer: Jacobians at the current estimate (Solà (13), (25), (33)); no memory."""

    def motion(
        self, motion: Motion, u: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, tuple[()]]:
        return (*motion_at(motion, point.pose, u, point.pose), ())

    def observe(
        self, sensor: Sensor, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        return observe_at(sensor, point, point.pose, point.landmark)

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array]:
        return invert_at(sensor, point.pose, z, point.pose, z)
