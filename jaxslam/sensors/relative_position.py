"""Cartesian position of a point landmark in the sensor's frame."""

import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.math import se2
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


def relative_position(noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET) -> Sensor:
    """The sensor of the Cartesian position of point landmarks in its frame.

    z = (ahead [m], left [m]) of l = (x, y): R(θ_S)ᵀ(l - t_S) with S = pose ∘ mount; Solà (56).

    The measurement of Huang et al. 2010 and of UKF-M's 2-D SLAM example. invert is Solà (55).

    Args:
        noise_cov: (2, 2) covariance of z, or a function of z.
        mount: (3,) pose of the sensor on the robot, Solà's S.
    Raises:
        ValueError: if noise_cov is not a (2, 2) covariance or mount not a finite (3,).
    """
    sensor_pose, sensor_pose_jacobian = mounting("relative_position", mount)

    def observe(pose: Pose, landmark: Landmark) -> Measurement:
        return se2.to_frame(sensor_pose(pose), landmark)

    def residual(z: Measurement, z_hat: Measurement) -> Measurement:
        return z - z_hat

    def invert(pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(sensor_pose(pose), z)

    def observe_jacobians(pose: Pose, landmark: Landmark) -> ObserveJacobians:
        by_frame, by_point = se2.to_frame_jacobians(sensor_pose(pose), landmark)
        return by_frame @ sensor_pose_jacobian(pose), by_point

    def invert_jacobians(pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        by_frame, by_point = se2.from_frame_jacobians(sensor_pose(pose), z)
        return by_frame @ sensor_pose_jacobian(pose), by_point, jnp.zeros((2, 0), pose.dtype)

    return Sensor(
        name="relative_position",
        measurements=("ahead [m]", "left [m]"),
        observe=observe,
        residual=residual,
        noise_cov=noise_model("relative_position", noise_cov, 2),
        invert=invert,
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
