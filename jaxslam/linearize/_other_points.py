"""Jacobians elsewhere than at the current estimate, for the sake of observability.

At the true state (the ideal EKF, a reference that only a simulation allows), at first estimates
that never change, or at points that keep the heading unobservable (OC).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxslam.core._numbers import largest
from jaxslam.core._record import record
from jaxslam.core.protocols import LinearizationPoint, Linearizer, Motion, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Truth
from jaxslam.linearize import _first_order as first_order
from jaxslam.linearize._first_order import with_lever_arm


@record
class AtTruth(Linearizer):
    """The linearizer of the ideal EKF: Jacobians at the truth; means are still the filter's.

    The linearized system then has the observability of the true one, so a NEES above its dof is not
    due to the linearization points (Huang, Mourikis, Roumeliotis 2010, "ideal EKF"). In
    the transition, F = [I, J(p_{k+1} - p_k); 0, 1], the displacement is the true one too, not that
    of the control.
    """

    truth: Truth
    """start, poses (T, 3) and landmarks (N, L), indexed by tag. Tags must be known."""
    own_landmarks = True

    def init(self, pose: Array, landmarks: Array) -> Array:
        return jnp.zeros((), jnp.int32)

    def motion(
        self, motion: Motion, u: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        old, new = self._pose(point.joint.lin, point), self._pose(point.joint.lin + 1, point)
        moved, by_pose, noise = first_order.motion_at(motion, point.pose, u, old)
        ahead = motion.step(old, u, jnp.zeros(len(motion.noises), old.dtype))
        # From the displacement of the control alone to the true one, noise included.
        return moved, with_lever_arm(by_pose, new[:2] - ahead[:2]), noise, point.joint.lin + 1

    def observe(
        self, sensor: Sensor, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        landmark = self._landmark(point.joint.tag[point.slot], point)
        return first_order.observe_at(sensor, point, self._pose(point.joint.lin, point), landmark)

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array]:
        pose = self._pose(point.joint.lin, point)
        true_z = sensor.observe(pose, self._landmark(tag, point))
        return first_order.invert_at(sensor, point.pose, z, pose, true_z)

    def _pose(self, step: Array, point: LinearizationPoint) -> Array:
        """The true robot (R,) after a number of steps, in the dtype of the run."""
        # Row t of the truth is the pose after motion t + 1; before the first it is the start.
        after = jnp.asarray(self.truth.robot)[jnp.maximum(step - 1, 0)]
        pose = jnp.where(step > 0, after, jnp.asarray(self.truth.start))
        if self.truth.further is not None:  # a filter of the pose alone does not use the rest
            pose = pose[: len(point.pose)]
        return pose.astype(point.pose.dtype)

    def _landmark(self, tag: Array, point: LinearizationPoint) -> Array:
        """The true landmark (L,) of a tag, likewise."""
        return jnp.asarray(self.truth.landmarks)[jnp.maximum(tag, 0)].astype(point.pose.dtype)


class First(NamedTuple):
    """The first estimates of the pose and the landmarks."""

    pose: Array
    """(R,) of this step, as predicted, before any measurement of it"""
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

    Further numbers of the robot (`Motion.state`) are of the prediction in H, as the pose is, and of
    the estimate in F; a state that a rotation of the map turns, as a velocity (v_x, v_y) in it,
    would need more. The process noise is that of the standard EKF. Euclidean chart and point
    landmarks only.
    """

    euclidean = True
    own_landmarks = True

    def init(self, pose: Array, landmarks: Array) -> First:
        return First(pose, landmarks)

    def motion(
        self, motion: Motion, u: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, First]:
        first = point.joint.lin
        moved, by_pose, noise = first_order.motion_at(motion, point.pose, u, point.pose)
        # From J(p̂_{k+1} - p̂_k⁺) to J(p̂_{k+1} - p̂_k).
        by_pose = with_lever_arm(by_pose, point.pose[:2] - first.pose[:2])
        return moved, by_pose, noise, first._replace(pose=moved)

    def observe(
        self, sensor: Sensor, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        first = point.joint.lin
        return first_order.observe_at(sensor, point, first.pose, first.landmarks[point.slot])

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array]:
        landmark, by_pose, cov = first_order.invert_at(sensor, point.pose, z, point.pose, z)
        return landmark, with_lever_arm(by_pose, point.pose[:2] - point.joint.lin.pose[:2]), cov

    def remember(self, joint: Joint, new: Array) -> First:
        landmarks = jnp.where(new[:, None], joint.landmarks, joint.lin.landmarks)
        return First(joint.lin.pose, landmarks)


class _Constraint(NamedTuple):
    """The unobservable rotation direction of the linearized system, as lever arms."""

    pose: Array
    """(R,) of this step, as predicted"""
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

    def init(self, pose: Array, landmarks: Array) -> _Constraint:
        return _Constraint(pose, pose[:2], landmarks)

    def motion(
        self, motion: Motion, u: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, _Constraint]:
        joint, old = point.joint, point.joint.lin
        moved, by_pose, noise = first_order.motion_at(motion, point.pose, u, point.pose)
        arms = joint.landmarks - joint.pose[None, :2] - old.landmarks + old.robot[None]
        arms = jnp.where(joint.alive[:, None], arms, 0.0)
        shift = arms.sum(axis=0) / (1 + joint.alive.sum(dtype=arms.dtype))
        # Of numbers whose squares overflow, the EKF's point.
        shift = jnp.where(jnp.abs(shift) <= largest(shift), shift, 0.0)
        # α_{k+1} = α_k + p̂_{k+1} - p*, and p* = p̂_k⁺ + shift.
        robot = old.robot + moved[:2] - joint.pose[:2] - shift
        # From J(p̂_{k+1} - p̂_k⁺) to J(p̂_{k+1} - p*).
        return moved, with_lever_arm(by_pose, -shift), noise, old._replace(pose=moved, robot=robot)

    def observe(
        self, sensor: Sensor, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        points = point.joint.lin
        at_landmark = points.pose[:2] + points.landmarks[point.slot] - points.robot
        return first_order.observe_at(sensor, point, points.pose, at_landmark)

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array]:
        return first_order.invert_at(sensor, point.pose, z, point.pose, z)

    def remember(self, joint: Joint, new: Array) -> _Constraint:
        arms = joint.lin.robot[None] + joint.landmarks - joint.pose[None, :2]
        landmarks = jnp.where(new[:, None], arms, joint.lin.landmarks)
        return _Constraint(joint.lin.pose, joint.lin.robot, landmarks)
