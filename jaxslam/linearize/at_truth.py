"""Jacobians at the true state: the ideal EKF, a reference that only a simulation allows."""

import jax.numpy as jnp
from jax import Array

from jaxslam.core.record import record
from jaxslam.linearize import first_order
from jaxslam.linearize.first_order import with_lever_arm
from jaxslam.protocols import Here, Linearizer, Motion, Sensor
from jaxslam.types import Truth


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

    def motion(self, motion: Motion, u: Array, here: Here) -> tuple[Array, Array, Array, Array]:
        old, new = self._pose(here.joint.lin, here), self._pose(here.joint.lin + 1, here)
        moved, by_pose, noise = first_order.motion_at(motion, here.pose, u, old)
        ahead = motion.step(old, u, jnp.zeros(len(motion.noises), old.dtype))
        return moved, with_lever_arm(by_pose, new[:2] - ahead[:2]), noise, here.joint.lin + 1

    def observe(self, sensor: Sensor, here: Here) -> tuple[Array, Array, Array, Array]:
        landmark = self._landmark(here.joint.tag[here.slot], here)
        return first_order.observe_at(sensor, here, self._pose(here.joint.lin, here), landmark)

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, here: Here
    ) -> tuple[Array, Array, Array]:
        pose = self._pose(here.joint.lin, here)
        true_z = sensor.observe(pose, self._landmark(tag, here))
        return first_order.invert_at(sensor, here.pose, z, pose, true_z)

    def _pose(self, step: Array, here: Here) -> Array:
        """The true pose (3,) after a number of steps, in the dtype of the run."""
        after = jnp.asarray(self.truth.pose)[jnp.maximum(step - 1, 0)]
        pose = jnp.where(step > 0, after, jnp.asarray(self.truth.start))
        return pose.astype(here.pose.dtype)

    def _landmark(self, tag: Array, here: Here) -> Array:
        """The true landmark (L,) of a tag, likewise."""
        return jnp.asarray(self.truth.landmarks)[jnp.maximum(tag, 0)].astype(here.pose.dtype)
