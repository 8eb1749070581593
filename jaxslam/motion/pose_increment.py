"""A relative pose as the control, as odometry or scan matching gives it."""

from jaxslam.core.record import record
from jaxslam.math import se2
from jaxslam.math.arrays import Control, Pose, ProcessNoise, StepJacobians
from jaxslam.noise import NoiseCov
from jaxslam.protocols import Motion


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

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        return se2.compose(pose, self.perturb(u, w))

    def perturb(self, u: Control, w: ProcessNoise) -> Control:
        return u + w

    def jacobians(self, pose: Pose, u: Control, w: ProcessNoise) -> StepJacobians:
        by_pose, by_increment = se2.compose_jacobians(pose, u + w)
        return by_pose, by_increment, by_increment
