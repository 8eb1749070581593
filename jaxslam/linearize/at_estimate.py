"""Jacobians at the current estimate: the standard EKF."""

import jax

from jaxslam.linearize import first_order
from jaxslam.protocols import Chart, Linearizer, Motion, Sensor
from jaxslam.slots import Joint

Array = jax.Array


def at_estimate() -> Linearizer:
    """Every Jacobian at the newest estimate of its arguments (Solà (13), (25), (33)); no memory."""

    def motion_at(
        joint: Joint, motion: Motion, chart: Chart, u: Array, cov: Array
    ) -> tuple[Array, Array, Array, tuple[()]]:
        return (*first_order.motion_at(motion, joint.pose, u, joint.pose), ())

    def observe_at(
        joint: Joint,
        sensor: Sensor,
        chart: Chart,
        slot: Array,
        pose: Array,
        landmark: Array,
        cov: Array,
    ) -> tuple[Array, Array, Array, Array]:
        return first_order.observe_at(sensor, pose, landmark, pose, landmark)

    def invert_at(
        joint: Joint, sensor: Sensor, chart: Chart, tag: Array, z: Array, cov: Array
    ) -> tuple[Array, Array, Array]:
        return first_order.invert_at(sensor, joint.pose, z, joint.pose, z)

    return Linearizer(
        name="at_estimate",
        init=lambda pose, landmarks: (),
        motion=motion_at,
        observe=observe_at,
        invert=invert_at,
        born=lambda joint, born: joint.lin,
    )
