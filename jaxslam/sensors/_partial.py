"""Sensors of one polar coordinate of a point landmark: bearing only or range only.

The other one is unmeasured, with a prior: Solà's s ~ N(s̄, S).
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Free, Sensor
from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import Check, covariance
from jaxslam.math import se2
from jaxslam.math._arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Pose,
    Unmeasured,
    is_concrete,
)
from jaxslam.math._definite import is_invertible

FreeLike = Free | tuple[ArrayLike, ArrayLike]


def prior(size: int) -> Check:
    """The check of free = (mean (size,), cov (size, size)), which becomes a `Free`.

    In float64 on the host unless traced; the mean finite, the covariance positive definite.
    """

    def check(value: FreeLike) -> Free:
        try:
            mean, cov = value
        except (TypeError, ValueError):
            raise ValueError(f"expected (mean, covariance), got {value!r}") from None
        mean, cov = _host_array(mean), _host_array(cov)
        if mean.shape != (size,):
            raise ValueError(f"expected a prior mean of shape ({size},), got {mean.shape}")
        if is_concrete(mean) and not (_is_real(mean) and np.all(np.isfinite(mean))):
            raise ValueError(f"expected a finite prior mean, got {mean}")
        covariance(size)(cov)
        if is_concrete(cov) and not is_invertible(np.asarray(cov)):
            raise ValueError("expected a positive definite prior covariance")
        return Free(mean, cov)

    return check


def _host_array(values: ArrayLike) -> JaxOrNumPy:
    """The array on the host in float64, for any default width of JAX."""
    if not is_concrete(values):
        return jnp.asarray(values)
    array = np.asarray(values)
    return array.astype(np.float64) if _is_real(array) else array


def _is_real(array: JaxOrNumPy) -> bool:
    return bool(np.issubdtype(array.dtype, np.number)) and not np.iscomplexobj(array)


class _PolarCoordinate(Sensor):
    """The sensor of one row of z = polar(to_frame(pose ∘ mount, l)), the other row being free.

    A subclass has a field `free`, mean (1,) and covariance (1, 1) of the other row.
    """

    _own: slice
    _other: slice

    def _polar(self, z: Measurement, s: Unmeasured) -> Array:
        # (range, bearing): the measured row is the second one of a bearing-only sensor.
        return jnp.concatenate([s, z] if self._own.start else [z, s])

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        return se2.polar_in_frame(self.frame(pose), landmark)[self._own]

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(self.frame(pose), se2.rectangular(self._polar(z, s)))

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        outer = se2.polar_jacobians(se2.to_frame(frame, landmark))[0][self._own]
        return outer @ by_frame @ self.frame_jacobian(pose), outer @ by_point

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        seen = self._polar(z, s)
        by_frame, by_point = se2.from_frame_jacobians(self.frame(pose), se2.rectangular(seen))
        by_polar = by_point @ se2.rectangular_jacobians(seen)[0]
        return (
            by_frame @ self.frame_jacobian(pose),
            by_polar[:, self._own],
            by_polar[:, self._other],
        )


_TEN_METRES = ((10.0,), ((25.0,),))
"""Range 10 m, σ 5 m: a placeholder for the actual prior knowledge."""


@record
class BearingOnly(_PolarCoordinate):
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
    free: FreeLike = field(default=_TEN_METRES, check=prior(1))  # type: ignore[assignment]
    """mean (1,) and covariance (1, 1) of the range [m], Solà (39)"""
    measurements = ("bearing [rad]",)
    equations = "bearing = wrap(atan2(l_y - y_s, l_x - x_s) - theta_s + n_bearing)"
    _own, _other = slice(1, 2), slice(0, 1)


_ANY_DIRECTION = ((0.0,), ((np.pi**2 / 3,),))
"""The Gaussian with the mean and the variance of a direction uniform on (-π, π]."""


@record
class RangeOnly(_PolarCoordinate):
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
    free: FreeLike = field(default=_ANY_DIRECTION, check=prior(1))  # type: ignore[assignment]
    """mean (1,) and covariance (1, 1) of the bearing [rad], Solà (39)"""
    measurements = ("range [m]",)
    equations = "range = sqrt((l_x - x_s)**2 + (l_y - y_s)**2) + n_range"
    _own, _other = slice(0, 1), slice(1, 2)
