"""Bearing of a point landmark, without its range: a camera, a radio direction finder."""

from numpy.typing import ArrayLike

from jaxslam.core.record import record
from jaxslam.noise import NoiseCov
from jaxslam.sensors.partial.polar_coordinate import PolarCoordinate
from jaxslam.sensors.partial.prior import FreeLike

TEN_METRES = ((10.0,), ((25.0,),))
"""Range 10 m, σ 5 m: a placeholder for the actual prior knowledge."""


@record
class BearingOnly(PolarCoordinate):
    """The bearing-only sensor of point landmarks.

    z = (bearing [rad]) of l = (x, y): the direction of R(θ_S)ᵀ(l - t_S), S = pose ∘ mount.

    The second row of Solà (63). invert is (64) with s = (range [m]) for the unmeasured coordinate:
    from_frame(S, rectangular((s, z))), s > 0; a negative range lies behind the sensor. A landmark
    exactly at the sensor gives z = 0 with zero derivatives, not NaN.

    Choose the prior for your application. The range has no upper bound, the bearing is strongly
    nonlinear in it, and an EKF linearizes once over the whole prior. A narrow prior may be wrong;
    with a wide one the linearization error makes the filter diverge (Solà 2.3.5). Landmarks
    initialized by inverse distance avoid this conflict: see `BearingInverseDepth`.
    """

    noise_cov: NoiseCov
    """(1, 1) covariance of the bearing, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot, Solà's S"""
    free: FreeLike = TEN_METRES  # type: ignore[assignment]
    """mean (1,) and covariance (1, 1) of the range [m], Solà (39)"""
    measurements = ("bearing [rad]",)
    _own, _other = slice(1, 2), slice(0, 1)
