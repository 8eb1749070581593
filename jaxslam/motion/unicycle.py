"""The unicycle model: constant velocities over an interval, integrated by one Euler step."""

import jax.numpy as jnp

from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Motion
from jaxslam.core.record import record
from jaxslam.math import se2
from jaxslam.math.arrays import Control, Pose, ProcessNoise, StepJacobians


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
        by_dt = jnp.stack([v * c, v * s, omega])
        return by_pose, jnp.concatenate([by_noise, by_dt[:, None]], axis=1), by_noise
