"""Range and bearing of a point landmark, as of a laser scanner or a sonar."""

import jax.numpy as jnp
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
from jaxslam.sensors.mounting import NO_OFFSET, mounting


def range_bearing(noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET) -> Sensor:
    """The range-bearing sensor of point landmarks.

    z = (range [m], bearing [rad]) of l = (x, y): polar(to_frame(pose ∘ mount, l)), Solà (63).

    invert is (64), from_frame(pose ∘ mount, rectangular(z)) (in the sensor's frame: errata).
    A landmark exactly at the sensor gives z = 0 with zero derivative by l, not NaN.

    Args:
        noise_cov: (2, 2) covariance of (range, bearing), or a function of z.
        mount: (3,) pose of the sensor on the robot, Solà's S.
    Raises:
        ValueError: if noise_cov is not a (2, 2) covariance or mount not a finite (3,).
    """
    sensor_pose, sensor_pose_jacobian = mounting("range_bearing", mount)

    def observe(pose: Pose, landmark: Landmark) -> Measurement:
        return se2.polar_in_frame(sensor_pose(pose), landmark)

    def residual(z: Measurement, z_hat: Measurement) -> Measurement:
        return jnp.stack([z[0] - z_hat[0], wrap(z[1] - z_hat[1])])

    def invert(pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(sensor_pose(pose), se2.rectangular(z))

    def observe_jacobians(pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = sensor_pose(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        (outer,) = se2.polar_jacobians(se2.to_frame(frame, landmark))
        return outer @ by_frame @ sensor_pose_jacobian(pose), outer @ by_point

    def invert_jacobians(pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        frame = sensor_pose(pose)
        by_frame, by_point = se2.from_frame_jacobians(frame, se2.rectangular(z))
        (inner,) = se2.rectangular_jacobians(z)
        by_s = jnp.zeros((2, 0), pose.dtype)
        return by_frame @ sensor_pose_jacobian(pose), by_point @ inner, by_s

    return Sensor(
        name="range_bearing",
        measurements=("range [m]", "bearing [rad]"),
        observe=observe,
        residual=residual,
        noise_cov=noise_model("range_bearing", noise_cov, 2),
        invert=invert,
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
