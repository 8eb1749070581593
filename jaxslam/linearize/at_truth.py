"""Jacobians at the true state: the ideal EKF, the yardstick no real filter can use."""

import jax
import jax.numpy as jnp

from jaxslam.linearize import first_order
from jaxslam.linearize.first_order import turned
from jaxslam.protocols import Chart, Linearizer, Motion, Sensor
from jaxslam.slots import Joint
from jaxslam.types import Truth

Array = jax.Array


def at_truth(truth: Truth) -> Linearizer:
    """Every Jacobian at the truth of a simulation; the mean is still the filter's own.

    The linearized system then has the observability of the true one, and what NEES is left above
    its dof is not the fault of linearization (Huang, Mourikis, Roumeliotis 2010, "ideal EKF"). In
    the transition, F = [I, J(p_{k+1} - p_k); 0, 1], the displacement is the true one too, not that
    of the control.

    Args:
        truth: start, poses (T, 3) and landmarks (N, L), indexed by tag. Tags must be known.
    """
    path = jnp.concatenate([jnp.asarray(truth.start)[None], truth.pose])

    def motion_at(
        joint: Joint, motion: Motion, chart: Chart, u: Array, cov: Array
    ) -> tuple[Array, Array, Array, Array]:
        old, new = path[joint.lin], path[joint.lin + 1]
        moved, by_pose, noise = first_order.motion_at(motion, joint.pose, u, old)
        ahead = motion.step(old, u, jnp.zeros(len(motion.noises), old.dtype))
        return moved, turned(by_pose, new[:2] - ahead[:2]), noise, joint.lin + 1

    def observe_at(
        joint: Joint,
        sensor: Sensor,
        chart: Chart,
        slot: Array,
        pose: Array,
        landmark: Array,
        cov: Array,
    ) -> tuple[Array, Array, Array, Array]:
        true_landmark = truth.landmarks[jnp.maximum(joint.tag[slot], 0)]
        return first_order.observe_at(sensor, pose, landmark, path[joint.lin], true_landmark)

    def invert_at(
        joint: Joint, sensor: Sensor, chart: Chart, tag: Array, z: Array, cov: Array
    ) -> tuple[Array, Array, Array]:
        true_z = sensor.observe(path[joint.lin], truth.landmarks[jnp.maximum(tag, 0)])
        return first_order.invert_at(sensor, joint.pose, z, path[joint.lin], true_z)

    return Linearizer(
        name="at_truth",
        init=lambda pose, landmarks: jnp.zeros((), jnp.int32),
        motion=motion_at,
        observe=observe_at,
        invert=invert_at,
        born=lambda joint, born: joint.lin,
    )
