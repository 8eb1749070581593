"""Measurement of the robot's heading in the map: a compass, a sun sensor."""

from numpy.typing import ArrayLike

from jaxslam.math.angles import wrap
from jaxslam.noise import NoiseCov
from jaxslam.protocols import Sensor
from jaxslam.sensors.absolute.absolute import absolute
from jaxslam.sensors.mounting import NO_OFFSET, mounting


def compass(noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET) -> Sensor:
    """The compass, an absolute sensor of the heading.

    z = (heading [rad]) = wrap(θ + θ_mount), counter-clockwise from the map's x-axis.

    An absolute sensor (Williams' list of observations): there is no landmark, L = 0, and `invert`,
    `embed` and `position` (zeros) are not used.

    Args:
        noise_cov: (1, 1) covariance of the heading, or a function of z.
        mount: (3,) pose of the sensor on the robot; only its angle matters.
    Raises:
        ValueError: if noise_cov is not a (1, 1) covariance or mount not a finite (3,).
    """
    sensor_pose, sensor_pose_jacobian = mounting("compass", mount)

    return absolute(
        "compass",
        ("heading [rad]",),
        observe=lambda pose: sensor_pose(pose)[2:],
        residual=lambda z, z_hat: wrap(z - z_hat),
        jacobian=lambda pose: sensor_pose_jacobian(pose)[2:],
        noise_cov=noise_cov,
    )
