"""Jacobians at the true state: the ideal EKF, the yardstick no real filter can use."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxslam import derivatives
from jaxslam.protocols import Linearizer, Motion, Sensor
from jaxslam.types import Truth

Array = jax.Array


def at_truth(truth: Truth, start: Array) -> Linearizer:
    """Every Jacobian at the truth of a simulation; the mean is still the filter's own.

    The linearized system then has the observability of the true one, and what NEES is left above
    its dof is not the fault of linearization (Huang, Mourikis, Roumeliotis 2010, "ideal EKF").

    Args:
        truth: poses (T, 3) at the scans and landmarks (N, L), indexed by tag. Tags must be known.
        start: (3,) the true pose before the first control.
    """
    path = jnp.concatenate([jnp.asarray(start)[None], truth.pose])

    def motion_at(memory: Any, motion: Motion, pose: Array, u: Array) -> tuple[Array, Array, Any]:
        by_pose, by_noise = derivatives.motion_jacobians(motion, path[memory], u)
        return by_pose, by_noise, memory + 1

    def observe_at(
        memory: Any, sensor: Sensor, slot: Array, tag: Array, pose: Array, landmark: Array
    ) -> tuple[Array, Array]:
        true_landmark = truth.landmarks[jnp.maximum(tag, 0)]
        return derivatives.observe_jacobians(sensor, path[memory], true_landmark)

    def invert_at(
        memory: Any, sensor: Sensor, tag: Array, pose: Array, z: Array, s: Array
    ) -> tuple[Array, Array, Array]:
        true_z = sensor.observe(path[memory], truth.landmarks[jnp.maximum(tag, 0)])
        return derivatives.invert_jacobians(sensor, path[memory], true_z, s)

    return Linearizer(
        name="at_truth",
        init=lambda capacity, pose: jnp.zeros((), jnp.int32),
        motion=motion_at,
        observe=observe_at,
        invert=invert_at,
        born=lambda memory, born, landmarks: memory,
    )
