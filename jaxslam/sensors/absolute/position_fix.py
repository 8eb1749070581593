"""Measurement of the robot's position in the map: a satellite receiver, a total station."""

from numpy.typing import ArrayLike

from jaxslam.core.record import record
from jaxslam.noise import NoiseCov
from jaxslam.sensors.absolute.absolute import Absolute


@record
class PositionFix(Absolute):
    """The position fix, an absolute sensor of the antenna's position.

    z = (x [m], y [m]) of the antenna: t + R(θ) t_mount, the translation of pose ∘ mount.

    An absolute sensor (GPS in Williams' list of observations): there is no landmark, L = 0, and
    `invert`, `embed` and `position` (zeros) are not used.
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of z, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the antenna on the robot; its angle does not matter."""
    measurements = ("x [m]", "y [m]")
    rows = slice(0, 2)
