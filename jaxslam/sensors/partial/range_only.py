"""Range of a point landmark, without its bearing: a radio beacon, a sonar's echo."""

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.record import record
from jaxslam.noise import NoiseCov
from jaxslam.sensors.partial.polar_coordinate import PolarCoordinate
from jaxslam.sensors.partial.prior import FreeLike

ANY_DIRECTION = ((0.0,), ((np.pi**2 / 3,),))
"""The Gaussian with the mean and the variance of a direction uniform on (-π, π]."""


@record
class RangeOnly(PolarCoordinate):
    """The range-only sensor of point landmarks.

    z = (range [m]) of l = (x, y): |l - t_S| with S = pose ∘ mount, the first row of Solà (63).

    invert is (64) with s = (bearing [rad]) in the sensor's frame for the unmeasured coordinate:
    from_frame(S, rectangular((z, s))), z >= 0. A landmark exactly at the sensor gives z = 0 with
    zero derivatives, not NaN.

    One Gaussian in x and y cannot represent a ring. With the default prior the linearized landmark
    is an ellipse along the ring's tangent ahead of the sensor, and a filter that starts from it is
    inconsistent; give a narrower prior where one is known.
    """

    noise_cov: NoiseCov
    """(1, 1) covariance of the range, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot, Solà's S"""
    free: FreeLike = ANY_DIRECTION  # type: ignore[assignment]
    """mean (1,) and covariance (1, 1) of the bearing [rad], Solà (39)"""
    measurements = ("range [m]",)
    _own, _other = slice(0, 1), slice(1, 2)
