"""Measurement of the robot's heading in the map: a compass, a sun sensor."""

from numpy.typing import ArrayLike

from jaxslam.core.record import record
from jaxslam.noise import NoiseCov
from jaxslam.sensors.absolute.absolute import Absolute


@record
class Compass(Absolute):
    """The compass, an absolute sensor of the heading.

    z = (heading [rad]) = wrap(θ + θ_mount), counter-clockwise from the map's x-axis.

    An absolute sensor (Williams' list of observations): there is no landmark, L = 0, and `invert`,
    `embed` and `position` (zeros) are not used.
    """

    noise_cov: NoiseCov
    """(1, 1) covariance of the heading, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot; only its angle matters."""
    measurements = ("heading [rad]",)
    rows = slice(2, 3)
