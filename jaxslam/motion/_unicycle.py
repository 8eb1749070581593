"""The unicycle model: constant velocities over an interval, integrated by one Euler step."""

import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Motion
from jaxslam.math import se2
from jaxslam.math._arrays import Control, Pose, ProcessNoise, ProcessNoiseCov, StepJacobians


@record
class Unicycle(Motion):
    """The unicycle model, integrated by one Euler step.

    u = (v [m/s], ω [rad/s], Δt [s]), with noise added to the velocities.

    pose ← (x + (v+w_v)Δt cos θ, y + (v+w_v)Δt sin θ, wrap(θ + (ω+w_ω)Δt)). The robot of Huang et
    al. 2010 and of UKF-M's 2-D SLAM example (Brossard et al. 2020); Δt = 0 gives no motion and no
    noise.
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of w = (w_v, w_ω), or a function of (pose, u): of the *velocity* over the
    interval, so the displacement's grows with Δt²."""
    controls = ("v [m/s]", "omega [rad/s]", "dt [s]")
    noises = ("v [m/s]", "omega [rad/s]")
    equations = (
        "x1 = x + (v + w_v)*dt*cos(theta)\n"
        "y1 = y + (v + w_v)*dt*sin(theta)\n"
        "theta1 = wrap(theta + (omega + w_omega)*dt)"
    )

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        v, omega, dt = self.perturb(u, w)
        return se2.compose(pose, jnp.stack([v * dt, jnp.zeros_like(dt), omega * dt]))

    def perturb(self, u: Control, w: ProcessNoise) -> Control:
        return jnp.stack([u[0] + w[0], u[1] + w[1], u[2]])

    def jacobians(self, pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        v, omega, dt = u[0] + w[0], u[1] + w[1], u[2]
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        by_pose = jnp.eye(3, dtype=pose.dtype)
        by_pose = by_pose.at[0, 2].set(-v * dt * s).at[1, 2].set(v * dt * c)
        by_noise = jnp.zeros((3, 2), pose.dtype)
        by_noise = by_noise.at[0, 0].set(dt * c).at[1, 0].set(dt * s).at[2, 1].set(dt)
        # Noise is added to v and ω, so ∂/∂u is ∂/∂w with a column for Δt.
        by_dt = jnp.stack([v * c, v * s, omega])
        return by_pose, jnp.concatenate([by_noise, by_dt[:, None]], axis=1), by_noise


@record
class WhiteNoise:
    """White noise of the velocities (v, ω), a function (pose, u) -> (2, 2).

        diag(travel², turn² + (turn_share ω)²) / Δt

    It does not depend on how time is cut into steps; where Δt = 0 it is 0.
    """

    travel: ArrayLike
    """[m/√s] standard deviation of the travel in a second"""
    turn: ArrayLike
    """[rad/√s] standard deviation of the heading in a second"""
    turn_share: ArrayLike = 0.0
    """[√s] standard deviation of the heading in a second, as a share of ω"""
    equations = (
        "variance_of_w_v = travel**2/dt\nvariance_of_w_omega = (turn**2 + (turn_share*omega)**2)/dt"
    )

    def __call__(self, pose: Pose, u: Control) -> ProcessNoiseCov:
        travel, turn, share = (
            jnp.asarray(value, u.dtype) for value in (self.travel, self.turn, self.turn_share)
        )
        moving = u[2] > 0  # else 1/Δt, and its gradient, would be infinite
        # Of velocities, hence over Δt: the displacement is Δt times them, its variance grows as Δt.
        density = jnp.diag(jnp.stack([travel**2, turn**2 + (share * u[1]) ** 2]))
        return density * jnp.where(moving, 1 / jnp.where(moving, u[2], 1.0), 0.0)
