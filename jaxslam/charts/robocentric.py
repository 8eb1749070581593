"""The robocentric error: differences of coordinates in the robot's frame."""

import jax.numpy as jnp

from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.math.arrays import Landmark, Pose
from jaxslam.math.xla import materialize
from jaxslam.protocols import Basis, Chart


def robocentric() -> Chart:
    """The robocentric chart: additive errors of the origin and the landmarks in the robot's frame.

    With b = pose⁻¹ and m = Rᵀ(l - t): b ← b + dx and m ← m + dl, so pose ← (b + dx)⁻¹ and
    l ← (b + dx)⁻¹ ∘ (m + dl). The measurements of a sensor on the robot do not depend on dx, hence
    they have no information on the frame, and the errors of the map are small near the robot. The
    last motion remains a separate variable until the update has corrected it, and only then is the
    map transformed to the new frame (`motion_apart`): added to m instead, the rotations of many
    corrections would scale the map up.
    Castellanos, Martinez-Cantin, Tardós, Neira, "Robocentric map joining: improving the consistency
    of EKF-SLAM", Robotics and Autonomous Systems 55(1), 2007. Landmarks l = (x, y) only.
    """

    def retract(pose: Pose, landmark: Landmark, dx: Pose, dl: Landmark) -> tuple[Pose, Landmark]:
        moved = materialize(se2.inverse(se2.inverse(pose) + dx))
        return moved, se2.from_frame(moved, se2.to_frame(pose, landmark) + dl)

    def local(
        pose0: Pose, landmark0: Landmark, pose: Pose, landmark: Landmark
    ) -> tuple[Pose, Landmark]:
        dx = se2.inverse(pose) - se2.inverse(pose0)
        dl = se2.to_frame(pose, landmark) - se2.to_frame(pose0, landmark0)
        return jnp.concatenate([dx[:2], wrap(dx[2:])]), dl

    def basis(pose: Pose, landmark: Landmark) -> Basis:
        c, s = materialize((jnp.cos(pose[2]), jnp.sin(pose[2])))
        one = jnp.ones_like(c)
        # With l = R(m - b), R = R(θ) and θ = -b_θ; and the same of t = -R b.
        turn = jnp.stack([c, -s, s, c]).reshape(2, 2)
        by_pose = jnp.stack([-c, s, pose[1], -s, -c, -pose[0], 0 * one, 0 * one, -one])
        cross = jnp.stack([-c, s, landmark[1], -s, -c, -landmark[0]])
        return Basis(pose=by_pose.reshape(3, 3), cross=cross.reshape(2, 3), landmark=turn)

    return Chart(
        name="robocentric",
        retract=retract,
        local=local,
        basis=basis,
        motion_apart=True,
        landmark_size=2,
    )
