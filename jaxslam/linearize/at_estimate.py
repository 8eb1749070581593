"""Jacobians at the current estimate: the standard EKF."""

from jax import Array

from jaxslam.core.record import record
from jaxslam.linearize import first_order
from jaxslam.protocols import Here, Linearizer, Motion, Sensor


@record
class AtEstimate(Linearizer):
    """The EKF linearizer: Jacobians at the current estimate (Solà (13), (25), (33)); no memory."""

    def motion(self, motion: Motion, u: Array, here: Here) -> tuple[Array, Array, Array, tuple[()]]:
        return (*first_order.motion_at(motion, here.pose, u, here.pose), ())

    def observe(self, sensor: Sensor, here: Here) -> tuple[Array, Array, Array, Array]:
        return first_order.observe_at(sensor, here, here.pose, here.landmark)

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, here: Here
    ) -> tuple[Array, Array, Array]:
        return first_order.invert_at(sensor, here.pose, z, here.pose, z)
