"""Jacobians at the current estimate: the standard EKF."""

import jax

from jaxslam.linearize import first_order
from jaxslam.protocols import Here, Linearizer, Motion, Sensor

Array = jax.Array


def at_estimate() -> Linearizer:
    """The EKF linearizer: Jacobians at the current estimate (Solà (13), (25), (33)); no memory."""

    def motion_at(motion: Motion, u: Array, here: Here) -> tuple[Array, Array, Array, tuple[()]]:
        return (*first_order.motion_at(motion, here.pose, u, here.pose), ())

    def observe_at(sensor: Sensor, here: Here) -> tuple[Array, Array, Array, Array]:
        return first_order.observe_at(sensor, here, here.pose, here.landmark)

    def invert_at(sensor: Sensor, z: Array, tag: Array, here: Here) -> tuple[Array, Array, Array]:
        return first_order.invert_at(sensor, here.pose, z, here.pose, z)

    return Linearizer(
        name="at_estimate",
        init=lambda pose, landmarks: (),
        motion=motion_at,
        observe=observe_at,
        invert=invert_at,
        born=lambda joint, born: joint.lin,
    )
