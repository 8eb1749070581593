"""The left-invariant error, in the robot's frame; its filter is known to be inconsistent."""

import jax.numpy as jnp

from jaxslam.core.record import record
from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.math.arrays import Landmark, Pose
from jaxslam.protocols import Basis, Chart


@record
class LeftInvariant(Chart):
    """The left-invariant chart: (R, t, l) ← (R, t, l)·exp(ξ), ξ in the Lie algebra of SE_{1+N}(2).

    With dx = (ρ, φ): θ ← θ + φ, t ← t + R V(φ) ρ, l ← l + R V(φ) dl, V as in `se2.exp`. The errors
    of robot and landmarks are in the estimated robot's frame, so a correction of its heading
    rotates them all; the unobservable directions depend on the estimate, as in the standard
    EKF. UKF-M (Brossard et al. 2020) shows that this choice is worse. Landmarks l = (x, y) only.
    """

    landmark_size = 2

    def retract(
        self, pose: Pose, landmark: Landmark, dx: Pose, dl: Landmark
    ) -> tuple[Pose, Landmark]:
        shift = se2.exp(jnp.concatenate([dl, dx[2:]]))[:2]
        return se2.boxplus(pose, dx), landmark + se2.rotation(pose[2]) @ shift

    def local(
        self, pose0: Pose, landmark0: Landmark, pose: Pose, landmark: Landmark
    ) -> tuple[Pose, Landmark]:
        shift = se2.rotation(pose0[2]).T @ (landmark - landmark0)
        turn = wrap(pose[2:] - pose0[2:])
        return se2.boxminus(pose, pose0), se2.log(jnp.concatenate([shift, turn]))[:2]

    def basis(self, pose: Pose, landmark: Landmark) -> Basis:
        turn = se2.rotation(pose[2])
        return Basis(
            pose=jnp.eye(3, dtype=pose.dtype).at[:2, :2].set(turn),
            cross=jnp.zeros((2, 3), pose.dtype),
            landmark=turn,
        )
