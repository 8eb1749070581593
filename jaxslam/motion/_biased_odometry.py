"""Odometry whose gyroscope has a bias and whose travel has a scale, both in the robot's state."""

import jax.numpy as jnp
from jax import Array

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import POSE, Motion
from jaxslam.math import se2
from jaxslam.math._arrays import Control, ProcessNoise, Robot, StepJacobians


@record
class BiasedOdometry(Motion):
    """The motion model of measured velocities with a bias and a scale that wander.

    Its state is (x, y, θ, b [rad/s], k [1]); u = (v [m/s], ω [rad/s], Δt [s]), as measured; the
    robot moves at k (v + w_v) and turns at ω + w_ω - b:

        pose ← pose ∘ exp(k (v + w_v)Δt, 0, (ω + w_ω - b)Δt),   b ← b + w_b Δt,   k ← k + w_k Δt.

    Start with k = 1. With `NoiseDensity((travel, turn, bias, scale))`, in [m/√s], [rad/√s],
    [rad/s/√s] and [1/√s], bias and scale are random walks. A robot that does not move does not
    see its scale; landmarks, a compass or a position fix tell the bias as it drives. Farrell,
    Aided Navigation (2008), 4.6.3, has the random walk of a gyroscope's bias.
    """

    noise_cov: NoiseCov
    """(4, 4) covariance of w = (w_v, w_ω, w_b, w_k), or a function of (robot, u)."""
    state = (*POSE, "bias [rad/s]", "scale [1]")
    controls = ("v [m/s]", "omega [rad/s]", "dt [s]")
    noises = ("v [m/s]", "omega [rad/s]", "bias [rad/s2]", "scale [1/s]")
    equations = (
        "arc = (omega + w_omega - bias)*dt\n"
        "chord = scale*(v + w_v)*dt*sinc(arc/2)\n"
        "x1 = x + chord*cos(theta + arc/2)\n"
        "y1 = y + chord*sin(theta + arc/2)\n"
        "theta1 = wrap(theta + arc)\n"
        "bias1 = bias + w_bias*dt\n"
        "scale1 = scale + w_scale*dt"
    )

    def step(self, pose: Robot, u: Control, w: ProcessNoise) -> Robot:
        moved = se2.boxplus(pose[:3], u[2] * self._rates(pose, u, w))
        return jnp.concatenate([moved, pose[3:] + u[2] * w[2:]])

    def jacobians(self, pose: Robot, u: Control, w: ProcessNoise) -> StepJacobians:
        dt, rates = u[2], self._rates(pose, u, w)
        by_pose, by_move = se2.compose_jacobians(pose[:3], se2.exp(dt * rates))
        (by_twist,) = se2.exp_jacobians(dt * rates)
        by_rates = by_move @ by_twist
        ahead, turn = by_rates[:, :1], by_rates[:, 2:]
        unit, zero = jnp.eye(2, dtype=pose.dtype), jnp.zeros((2, 3), pose.dtype)
        by_bias_and_scale = jnp.concatenate([-dt * turn, dt * (u[0] + w[0]) * ahead], axis=1)
        by_velocities = jnp.concatenate([dt * pose[4] * ahead, dt * turn], axis=1)
        top = jnp.concatenate([by_pose, by_bias_and_scale], axis=1)
        by_robot = jnp.concatenate([top, jnp.concatenate([zero, unit], axis=1)])
        by_dt = jnp.concatenate([by_rates @ rates, w[2:]])[:, None]
        by_u = jnp.concatenate([jnp.concatenate([by_velocities, 0 * unit]), by_dt], axis=1)
        of_pose = jnp.concatenate([by_velocities, jnp.zeros((3, 2), pose.dtype)], axis=1)
        by_w = jnp.concatenate([of_pose, jnp.concatenate([0 * unit, dt * unit], axis=1)])
        return by_robot, by_u, by_w

    def _rates(self, robot: Robot, u: Control, w: ProcessNoise) -> Array:
        """The velocities (3,) of the robot in its axes."""
        travel, turn = robot[4] * (u[0] + w[0]), u[1] + w[1] - robot[3]
        return jnp.stack([travel, jnp.zeros_like(travel), turn])
