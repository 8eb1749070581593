"""Motion by increments: forward and turn (Solà's guide), or a relative pose (scan matching)."""

import jax.numpy as jnp

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Motion
from jaxslam.math import se2
from jaxslam.math._arrays import Control, Pose, ProcessNoise, StepJacobians


@record
class Increment(Motion):
    """The motion model of a forward motion followed by a turn: Solà C.2.1.

    u = (forward d [m], turn δ [rad]), with additive noise:

    pose ← (x + (d+w_d) cos θ, y + (d+w_d) sin θ, wrap(θ + δ + w_δ)).
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of w = (w_d, w_δ), or a function of (pose, u)."""
    controls = ("forward [m]", "turn [rad]")
    noises = ("forward [m]", "turn [rad]")
    equations = (
        "x1 = x + (forward + w_forward)*cos(theta)\n"
        "y1 = y + (forward + w_forward)*sin(theta)\n"
        "theta1 = wrap(theta + turn + w_turn)"
    )

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        d, turn = self.perturb(u, w)
        return se2.compose(pose, jnp.stack([d, jnp.zeros_like(d), turn]))

    def perturb(self, u: Control, w: ProcessNoise) -> Control:
        return u + w

    def jacobians(self, pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        d = u[0] + w[0]
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        by_pose = jnp.eye(3, dtype=pose.dtype).at[0, 2].set(-d * s).at[1, 2].set(d * c)
        by_noise = jnp.zeros((3, 2), pose.dtype).at[0, 0].set(c).at[1, 0].set(s).at[2, 1].set(1)
        return by_pose, by_noise, by_noise


@record
class PoseIncrement(Motion):
    """The motion model of a relative pose with additive noise: pose ⊕ (u + w).

    u = (δx [m], δy [m], δθ [rad]) in the robot's frame.

    t ← t + R(θ)(δt + w_t), θ ← wrap(θ + δθ + w_θ): Solà A.3 (59), (60); Williams' ⊕.
    """

    noise_cov: NoiseCov
    """(3, 3) covariance of w = (w_x, w_y, w_θ), or a function of (pose, u)."""
    controls = ("forward [m]", "left [m]", "turn [rad]")
    noises = ("forward [m]", "left [m]", "turn [rad]")
    equations = (
        "x1 = x + (forward + w_forward)*cos(theta) - (left + w_left)*sin(theta)\n"
        "y1 = y + (forward + w_forward)*sin(theta) + (left + w_left)*cos(theta)\n"
        "theta1 = wrap(theta + turn + w_turn)"
    )

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        return se2.compose(pose, self.perturb(u, w))

    def perturb(self, u: Control, w: ProcessNoise) -> Control:
        return u + w

    def jacobians(self, pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        by_pose, by_increment = se2.compose_jacobians(pose, u + w)
        return by_pose, by_increment, by_increment
