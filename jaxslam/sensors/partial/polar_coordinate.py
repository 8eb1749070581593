"""A sensor of one polar coordinate of a point landmark: `range_only` and `bearing_only`."""

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.math.arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Pose,
    Unmeasured,
)
from jaxslam.noise import NoiseCov, noise_model
from jaxslam.protocols import Sensor
from jaxslam.sensors.mounting import mounting
from jaxslam.sensors.partial.prior import FreeLike, free_parameters


def polar_coordinate(
    name: str, measurement: str, noise_cov: NoiseCov, mount: ArrayLike, free: FreeLike
) -> Sensor:
    """The sensor of one row of z = polar(to_frame(pose ∘ mount, l)), the other row being free.

    Args:
        measurement: the name with the unit; [m] is the first row of Solà (63), [rad] the second.
        noise_cov: (1, 1) covariance of z, or a function of z.
        mount: (3,) pose of the sensor on the robot.
        free: mean (1,) and covariance (1, 1) of the other row.
    Raises:
        ValueError: if noise_cov, mount or free is none.
    """
    sensor_pose, sensor_pose_jacobian = mounting(name, mount)
    angle = measurement.endswith("[rad]")
    own, other = (slice(1, 2), slice(0, 1)) if angle else (slice(0, 1), slice(1, 2))

    def polar(z: Measurement, s: Unmeasured) -> Array:
        return jnp.concatenate([s, z] if angle else [z, s])

    def observe(pose: Pose, landmark: Landmark) -> Measurement:
        return se2.polar_in_frame(sensor_pose(pose), landmark)[own]

    def residual(z: Measurement, z_hat: Measurement) -> Measurement:
        return wrap(z - z_hat) if angle else z - z_hat

    def invert(pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(sensor_pose(pose), se2.rectangular(polar(z, s)))

    def observe_jacobians(pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = sensor_pose(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        outer = se2.polar_jacobians(se2.to_frame(frame, landmark))[0][own]
        return outer @ by_frame @ sensor_pose_jacobian(pose), outer @ by_point

    def invert_jacobians(pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        seen = polar(z, s)
        by_frame, by_point = se2.from_frame_jacobians(sensor_pose(pose), se2.rectangular(seen))
        by_polar = by_point @ se2.rectangular_jacobians(seen)[0]
        return by_frame @ sensor_pose_jacobian(pose), by_polar[:, own], by_polar[:, other]

    return Sensor(
        name=name,
        measurements=(measurement,),
        observe=observe,
        residual=residual,
        noise_cov=noise_model(name, noise_cov, 1),
        invert=invert,
        free=free_parameters(name, free, 1),
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
