"""Observability-constrained (OC) linearization points, which keep the heading unobservable."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxslam.core.numbers import largest
from jaxslam.core.record import record
from jaxslam.linearize import first_order
from jaxslam.linearize.first_order import with_lever_arm
from jaxslam.protocols import Here, Linearizer, Motion, Sensor
from jaxslam.slots import Joint


class Constraint(NamedTuple):
    """The unobservable rotation direction of the linearized system, as lever arms."""

    pose: Array
    """(3,) of this step, as predicted"""
    robot: Array
    """(2,) α [m]: the rotation moves the robot by J α"""
    landmarks: Array
    """(N, 2) β_i [m]: and the landmarks by J β_i"""


@record
class Observability(Linearizer):
    """The OC linearizer: points nearest to the estimates that satisfy the observability constraint.

    A rotation of robot and map, (Jα, 1, Jβ_1, …) in the errors of robot position, heading and
    landmarks, J = [0, -1; 1, 0], stays unobservable if every H of step k is taken at a landmark l*
    with l*_i - p̂_k = β_i - α_k, while F, taken between p* and p̂_{k+1}, propagates
    α_{k+1} = α_k + p̂_{k+1} - p*. Both conditions hold for l*_i = β_i - α_k + p*; p* and all l*_i
    minimize |p̂_k⁺ - p*|² + Σ_i |l̂_i - l*_i|² over the n landmarks of the map,

        p* = p̂_k⁺ + Σ_i (l̂_i - p̂_k⁺ - β_i + α_k)/(1 + n),

    for n = 1 half way between. Huang, Mourikis, Roumeliotis, "Observability-based rules for
    designing consistent EKF SLAM estimators", IJRR 29(5), 2010, state it for one landmark. The
    process noise is that of the standard EKF. Euclidean chart and point landmarks only.
    """

    euclidean = True
    own_landmarks = True

    def init(self, pose: Array, landmarks: Array) -> Constraint:
        return Constraint(pose, pose[:2], landmarks)

    def motion(
        self, motion: Motion, u: Array, here: Here
    ) -> tuple[Array, Array, Array, Constraint]:
        joint, old = here.joint, here.joint.lin
        moved, by_pose, noise = first_order.motion_at(motion, here.pose, u, here.pose)
        arms = joint.landmarks - joint.pose[None, :2] - old.landmarks + old.robot[None]
        arms = jnp.where(joint.alive[:, None], arms, 0.0)
        shift = arms.sum(axis=0) / (1 + joint.alive.sum())
        # Of numbers whose squares overflow, the EKF's point.
        shift = jnp.where(jnp.abs(shift) <= largest(shift), shift, 0.0)
        robot = old.robot + moved[:2] - joint.pose[:2] - shift
        return moved, with_lever_arm(by_pose, -shift), noise, old._replace(pose=moved, robot=robot)

    def observe(self, sensor: Sensor, here: Here) -> tuple[Array, Array, Array, Array]:
        own = here.joint.lin
        at_landmark = own.pose[:2] + own.landmarks[here.slot] - own.robot
        return first_order.observe_at(sensor, here, own.pose, at_landmark)

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, here: Here
    ) -> tuple[Array, Array, Array]:
        return first_order.invert_at(sensor, here.pose, z, here.pose, z)

    def born(self, joint: Joint, born: Array) -> Constraint:
        arms = joint.lin.robot[None] + joint.landmarks - joint.pose[None, :2]
        landmarks = jnp.where(born[:, None], arms, joint.lin.landmarks)
        return Constraint(joint.lin.pose, joint.lin.robot, landmarks)
