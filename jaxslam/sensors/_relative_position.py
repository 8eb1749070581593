"""Cartesian position of a point landmark in the sensor's frame."""

import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Sensor
from jaxslam.math import se2
from jaxslam.math._arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Pose,
    Unmeasured,
)


@record
class RelativePosition(Sensor):
    """The sensor of the Cartesian position of point landmarks in its frame.

    z = (ahead [m], left [m]) of l = (x, y): R(θ_S)ᵀ(l - t_S) with S = pose ∘ mount; Solà (56).

    The measurement of Huang et al. 2010 and of UKF-M's 2-D SLAM example. invert is Solà (55).
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of z, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot, Solà's S"""
    measurements = ("ahead [m]", "left [m]")
    equations = (
        "ahead = (l_x - x_s)*cos(theta_s) + (l_y - y_s)*sin(theta_s) + n_ahead\n"
        "left = (l_y - y_s)*cos(theta_s) - (l_x - x_s)*sin(theta_s) + n_left"
    )

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        return se2.to_frame(self.frame(pose), landmark)

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(self.frame(pose), z)

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        by_frame, by_point = se2.to_frame_jacobians(self.frame(pose), landmark)
        return by_frame @ self.frame_jacobian(pose), by_point

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        by_frame, by_point = se2.from_frame_jacobians(self.frame(pose), z)
        return by_frame @ self.frame_jacobian(pose), by_point, jnp.zeros((2, 0), pose.dtype)
