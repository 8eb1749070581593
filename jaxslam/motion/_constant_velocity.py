"""A robot that keeps its velocities, but for white accelerations: its speeds are in its state."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import POSE, Motion
from jaxslam.math import se2
from jaxslam.math._arrays import Control, ProcessNoise, ProcessNoiseCov, Robot, StepJacobians


@record
class ConstantVelocity(Motion):
    """The motion model of a robot without odometry, whose velocities change by white accelerations.

    Its state is (x, y, θ, v [m/s], ω [rad/s]), v along the robot's axis; u = (Δt [s]). Over an
    interval the accelerations w = (a, α) are constant:

        pose ← pose ∘ exp(vΔt + aΔt²/2, 0, ωΔt + αΔt²/2),   v ← v + aΔt,   ω ← ω + αΔt.

    `NoiseDensity` gives accelerations whose effect on v and ω does not depend on how time is cut
    into steps. `sensors.Speed`, `TurnRate` and `RangeRate` measure the velocities. Bar-Shalom, Li &
    Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 6.3.2, in the frame
    of the robot.
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of w = (a, α), or a function of (robot, u)."""
    state = (*POSE, "v [m/s]", "omega [rad/s]")
    controls = ("dt [s]",)
    noises = ("a [m/s2]", "alpha [rad/s2]")
    equations = (
        "arc = omega*dt + w_alpha*dt**2/2\n"
        "chord = (v*dt + w_a*dt**2/2)*sinc(arc/2)\n"
        "x1 = x + chord*cos(theta + arc/2)\n"
        "y1 = y + chord*sin(theta + arc/2)\n"
        "theta1 = wrap(theta + arc)\n"
        "v1 = v + w_a*dt\n"
        "omega1 = omega + w_alpha*dt"
    )

    def step(self, pose: Robot, u: Control, w: ProcessNoise) -> Robot:
        moved = se2.boxplus(pose[:3], self._twist(pose, u, w))
        return jnp.concatenate([moved, pose[3:] + u[0] * w])

    def jacobians(self, pose: Robot, u: Control, w: ProcessNoise) -> StepJacobians:
        (dt,), twist = u, self._twist(pose, u, w)
        by_pose, by_move = se2.compose_jacobians(pose[:3], se2.exp(twist))
        (by_twist,) = se2.exp_jacobians(twist)
        by_rates = (by_move @ by_twist)[:, ::2]  # of travel and turn; nothing moves to the side
        unit = jnp.eye(2, dtype=pose.dtype)
        below = jnp.concatenate([jnp.zeros((2, 3), pose.dtype), unit], axis=1)
        by_robot = jnp.concatenate([by_pose, dt * by_rates], axis=1)
        by_dt = jnp.concatenate([by_rates @ (pose[3:] + dt * w), w])
        by_noise = jnp.concatenate([dt**2 / 2 * by_rates, dt * unit])
        return jnp.concatenate([by_robot, below]), by_dt[:, None], by_noise

    def _twist(self, robot: Robot, u: Control, w: ProcessNoise) -> Array:
        travel, turn = robot[3:] * u[0] + w * (u[0] ** 2 / 2)
        return jnp.stack([travel, jnp.zeros_like(travel), turn])


@record
class NoiseDensity:
    """White noise of rates, a function (robot, u) -> (W, W): diag(sigma²)/Δt, Δt the last control.

    Integrated over an interval it has standard deviation σ √Δt, however time is cut into steps; 0
    where Δt = 0.
    """

    sigma: ArrayLike
    """(W,) standard deviations in a second of what the noises are rates of: of the velocities in
    `ConstantVelocity`, [m/s/√s] and [rad/s/√s]; in `BiasedOdometry` see there"""

    def __call__(self, pose: Robot, u: Control) -> ProcessNoiseCov:
        moving = u[-1] > 0  # else 1/Δt, and its gradient, would be infinite
        per_time = jnp.where(moving, 1 / jnp.where(moving, u[-1], 1.0), 0.0)
        return jnp.diag(jnp.asarray(self.sigma, u.dtype) ** 2) * per_time
