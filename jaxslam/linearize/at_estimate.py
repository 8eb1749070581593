"""Jacobians at the current estimate: the standard EKF."""

from typing import Any

import jax

from jaxslam import derivatives
from jaxslam.protocols import Linearizer, Motion, Sensor

Array = jax.Array


def at_estimate() -> Linearizer:
    """Every Jacobian at the newest estimate of its arguments (Solà (13), (25), (33)); no memory."""

    def motion_at(memory: Any, motion: Motion, pose: Array, u: Array) -> tuple[Array, Array, Any]:
        return (*derivatives.motion_jacobians(motion, pose, u), memory)

    def observe_at(
        memory: Any, sensor: Sensor, slot: Array, tag: Array, pose: Array, landmark: Array
    ) -> tuple[Array, Array]:
        return derivatives.observe_jacobians(sensor, pose, landmark)

    def invert_at(
        memory: Any, sensor: Sensor, tag: Array, pose: Array, z: Array, s: Array
    ) -> tuple[Array, Array, Array]:
        return derivatives.invert_jacobians(sensor, pose, z, s)

    return Linearizer(
        name="at_estimate",
        init=lambda capacity, pose: (),
        motion=motion_at,
        observe=observe_at,
        invert=invert_at,
        born=lambda memory, born, landmarks: memory,
    )
