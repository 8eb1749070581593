"""Jacobians at the true state: the ideal EKF, a reference that only a simulation allows."""

import jax
import jax.numpy as jnp

from jaxslam.linearize import first_order
from jaxslam.linearize.first_order import with_lever_arm
from jaxslam.protocols import Here, Linearizer, Motion, Sensor
from jaxslam.types import Truth

Array = jax.Array


def at_truth(truth: Truth) -> Linearizer:
    """The linearizer of the ideal EKF: Jacobians at the truth; means are still the filter's.

    The linearized system then has the observability of the true one, so a NEES above its dof is not
    due to the linearization points (Huang, Mourikis, Roumeliotis 2010, "ideal EKF"). In
    the transition, F = [I, J(p_{k+1} - p_k); 0, 1], the displacement is the true one too, not that
    of the control.

    Args:
        truth: start, poses (T, 3) and landmarks (N, L), indexed by tag. Tags must be known.
    """
    path = jnp.concatenate([jnp.asarray(truth.start)[None], truth.pose])
    landmarks = jnp.asarray(truth.landmarks)

    def at(step: Array, here: Here) -> Array:
        """The true pose (3,) in the dtype of the run."""
        return path[step].astype(here.pose.dtype)

    def seen(tag: Array, here: Here) -> Array:
        """The true landmark (L,) of a tag, likewise."""
        return landmarks[jnp.maximum(tag, 0)].astype(here.pose.dtype)

    def motion_at(motion: Motion, u: Array, here: Here) -> tuple[Array, Array, Array, Array]:
        old, new = at(here.joint.lin, here), at(here.joint.lin + 1, here)
        moved, by_pose, noise = first_order.motion_at(motion, here.pose, u, old)
        ahead = motion.step(old, u, jnp.zeros(len(motion.noises), old.dtype))
        return moved, with_lever_arm(by_pose, new[:2] - ahead[:2]), noise, here.joint.lin + 1

    def observe_at(sensor: Sensor, here: Here) -> tuple[Array, Array, Array, Array]:
        true_landmark = seen(here.joint.tag[here.slot], here)
        return first_order.observe_at(sensor, here, at(here.joint.lin, here), true_landmark)

    def invert_at(sensor: Sensor, z: Array, tag: Array, here: Here) -> tuple[Array, Array, Array]:
        at_pose = at(here.joint.lin, here)
        true_z = sensor.observe(at_pose, seen(tag, here))
        return first_order.invert_at(sensor, here.pose, z, at_pose, true_z)

    return Linearizer(
        name="at_truth",
        init=lambda pose, landmarks: jnp.zeros((), jnp.int32),
        motion=motion_at,
        observe=observe_at,
        invert=invert_at,
        born=lambda joint, born: joint.lin,
        own_landmarks=True,
    )
