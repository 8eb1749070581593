"""Measurement of the robot's position in the map: a satellite receiver, a total station."""

from numpy.typing import ArrayLike

from jaxslam.noise import NoiseCov
from jaxslam.protocols import Sensor
from jaxslam.sensors.absolute.absolute import absolute
from jaxslam.sensors.mounting import NO_OFFSET, mounting


def position_fix(noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET) -> Sensor:
    """The position fix, an absolute sensor of the antenna's position.

    z = (x [m], y [m]) of the antenna: t + R(θ) t_mount, the translation of pose ∘ mount.

    An absolute sensor (GPS in Williams' list of observations): there is no landmark, L = 0, and
    `invert`, `embed` and `position` (zeros) are not used.

    Args:
        noise_cov: (2, 2) covariance of z, or a function of z.
        mount: (3,) pose of the antenna on the robot; its angle does not matter.
    Raises:
        ValueError: if noise_cov is not a (2, 2) covariance or mount not a finite (3,).
    """
    sensor_pose, sensor_pose_jacobian = mounting("position_fix", mount)

    return absolute(
        "position_fix",
        ("x [m]", "y [m]"),
        observe=lambda pose: sensor_pose(pose)[:2],
        residual=lambda z, z_hat: z - z_hat,
        jacobian=lambda pose: sensor_pose_jacobian(pose)[:2],
        noise_cov=noise_cov,
    )
