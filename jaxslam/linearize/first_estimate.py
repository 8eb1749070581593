"""First-estimates Jacobians: each state has one linearization point that never changes."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxslam.core.record import record
from jaxslam.linearize import first_order
from jaxslam.linearize.first_order import with_lever_arm
from jaxslam.protocols import Here, Linearizer, Motion, Sensor
from jaxslam.slots import Joint


class First(NamedTuple):
    """The first estimates of the pose and the landmarks."""

    pose: Array
    """(3,) of this step, as predicted, before any measurement of it"""
    landmarks: Array
    """(N, L) as they entered the map"""


@record
class FirstEstimate(Linearizer):
    """The FEJ linearizer: a pose at its prediction, a landmark at its first estimate.

    With x̂_k the predicted pose of step k and x̂_k⁺ the corrected one, the transition becomes
    F = [I, J(p̂_{k+1} - p̂_k); 0, 1], J = [0, -1; 1, 0], in place of J(p̂_{k+1} - p̂_k⁺), and
    H = H(x̂_k, first l̂). So each state has one value in all Jacobians, and the linearized system
    keeps the three unobservable directions of the true one, but linearizes at first estimates,
    which may be poor. Huang, Mourikis, Roumeliotis, "Analysis and improvement of the
    consistency of extended Kalman filter based SLAM", ICRA 2008; IJRR 29(5), 2010.

    A new landmark is linearized at the predicted position of the robot, too, from which its
    covariance then follows: G_R = [I, J(l̂ - p̂_k)], as the definition has it. The authors' program
    takes the corrected position, from which this differs by up to 0.034 m over 800 steps.

    The process noise is that of the standard EKF. Euclidean chart and point landmarks only.
    """

    euclidean = True
    own_landmarks = True

    def init(self, pose: Array, landmarks: Array) -> First:
        return First(pose, landmarks)

    def motion(self, motion: Motion, u: Array, here: Here) -> tuple[Array, Array, Array, First]:
        first = here.joint.lin
        moved, by_pose, noise = first_order.motion_at(motion, here.pose, u, here.pose)
        by_pose = with_lever_arm(by_pose, here.pose[:2] - first.pose[:2])
        return moved, by_pose, noise, first._replace(pose=moved)

    def observe(self, sensor: Sensor, here: Here) -> tuple[Array, Array, Array, Array]:
        first = here.joint.lin
        return first_order.observe_at(sensor, here, first.pose, first.landmarks[here.slot])

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, here: Here
    ) -> tuple[Array, Array, Array]:
        landmark, by_pose, own = first_order.invert_at(sensor, here.pose, z, here.pose, z)
        return landmark, with_lever_arm(by_pose, here.pose[:2] - here.joint.lin.pose[:2]), own

    def born(self, joint: Joint, born: Array) -> First:
        landmarks = jnp.where(born[:, None], joint.landmarks, joint.lin.landmarks)
        return First(joint.lin.pose, landmarks)
