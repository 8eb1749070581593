"""Bearing of a landmark with inverse-depth parameters: anchor position, direction, 1/distance."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from jaxslam.core._record import field, record
from jaxslam.core.noise import NoiseCov
from jaxslam.core.protocols import Free, Reduced, Sensor
from jaxslam.core.validation import or_none, positive
from jaxslam.math import se2
from jaxslam.math._arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Point,
    Pose,
    Unmeasured,
    is_concrete,
)
from jaxslam.math.angles import wrap
from jaxslam.sensors._partial import BearingOnly, FreeLike, prior

_FAR = 1e-6
"""[1/m] least inverse distance that `position` uses."""

_NEAR = 1e-6
"""[m] least distance with which `embed` starts a landmark."""


def _check_distance(min_distance: ArrayLike) -> ArrayLike:
    positive(min_distance)
    if is_concrete(min_distance):
        with np.errstate(all="ignore"):  # the square of 1/min_distance may be 0 or infinite
            sigma = 0.25 / np.asarray(min_distance, np.float64)
            prior(1)(([2 * sigma], [[sigma**2]]))
    return min_distance


@record
class BearingInverseDepth(Sensor):
    """The bearing sensor with landmarks in inverse-depth parameters: Solà 2.3.6.

    z = (bearing [rad]) of l = (x0 [m], y0 [m], alpha [rad], rho [1/m]).

    p0 = (x0, y0) is the sensor's position at the first measurement, α the direction in the map, ρ
    the inverse distance (46), (49). From another position t_S, S = pose ∘ mount, the line of sight,
    scaled by ρ, is (51)

        v = ρ(p0 - t_S) + (cos α, sin α)        z = bearing of R(θ_S)ᵀ v

    which is linear in ρ and regular at ρ = 0, a landmark at infinity, and below: noise may make the
    estimate of a distant landmark negative. (The unscaled (50) is singular at 0, and for ρ < 0 it
    has the opposite direction.) Where v = 0, z is 0 with zero derivatives. invert is (53),
    l = (t_S, wrap(θ_S + z), s), with s = (inverse depth [1/m]).

    position is (48), p0 + (cos α, sin α)/ρ_c, with ρ_c = max(ρ, 1e-6): a landmark at infinity or
    beyond is placed 1000 km away in its direction. Its derivative by ρ is -1/ρ_c² also where ρ is
    clipped, so that a propagated covariance is large there, and not zero. embed bounds the distance
    below by 1e-6 m.

    to_point: a landmark becomes a point (x, y), which frees two of its coordinates, once a point is
    as accurate in a first-order filter. With the point at distance d_0 = 1/ρ from p0 and at d from
    the sensor, and the angle γ between the two lines of sight, the linearity index of Civera,
    Davison & Montiel ("Inverse depth to depth conversion for monocular SLAM", ICRA 2007)

        L_d = 4 (σ_ρ/ρ²) |cos γ| / d

    is below it; they take 0.1. A landmark with ρ <= 0 stays a ray.

    Raises ValueError unless min_distance is positive and finite, inverse_distance a Gaussian of
    positive variance, and to_point above 0.
    """

    noise_cov: NoiseCov
    """(1, 1) covariance of the bearing, or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot, Solà's S"""
    min_distance: ArrayLike = field(default=1.0, check=_check_distance)
    """[m] the least distance of a landmark, Solà's d_min (47)"""
    inverse_distance: FreeLike | None = field(default=None, check=or_none(prior(1)))
    """mean (1,) and covariance (1, 1) of s. By default mean 1/(2 d_min) and σ 1/(4 d_min), so that
    2 σ span 0 to 1/d_min."""
    to_point: ArrayLike | None = field(default=None, check=or_none(positive))
    """L_d below which landmarks become points; None: never"""
    measurements = ("bearing [rad]",)
    landmark = ("x0 [m]", "y0 [m]", "alpha [rad]", "rho [1/m]")
    equations = (
        "l_x = l_x0 + cos(l_alpha)/l_rho\n"
        "l_y = l_y0 + sin(l_alpha)/l_rho\n"
        "bearing = wrap(atan2(l_y - y_s, l_x - x_s) - theta_s + n_bearing)"
    )

    @property
    def free(self) -> Free:  # type: ignore[override]
        """The prior of s, an inverse distance in [0, 1/min_distance]."""
        if isinstance(self.inverse_distance, Free):
            return self.inverse_distance
        sigma = 0.25 / jnp.asarray(self.min_distance)
        return Free((2 * sigma)[None], (sigma**2)[None, None])

    @property
    def reduced(self) -> Reduced | None:  # type: ignore[override]
        """The points that landmarks become, with to_point."""
        if self.to_point is None:
            return None
        points = BearingOnly(self.noise_cov, self.mount, free=((1.0,), ((1.0,),)))
        return Reduced(points, self._ready)

    def _sight(self, frame: Array, landmark: Landmark) -> tuple[Array, Array]:
        """The vector v, and the sensor's frame moved to the map's origin."""
        v = landmark[3] * (landmark[:2] - frame[:2]) + _direction(landmark[2])
        return v, frame.at[:2].set(0.0)

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        v, axes = self._sight(self.frame(pose), landmark)
        return se2.polar(se2.to_frame(axes, v))[1:]

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        frame = self.frame(pose)
        return jnp.concatenate([frame[:2], wrap(frame[2:] + z), s])

    def position(self, landmark: Landmark) -> Point:
        # max(ρ, _FAR) with derivative 1 everywhere. Added to the clipped value, not to ρ, the term
        # is an exact zero: in float32 ρ + (_FAR - ρ) could be 0.
        inverse = landmark[3]
        cut = jax.lax.stop_gradient(jnp.maximum(inverse, _FAR))
        inverse = cut + (inverse - jax.lax.stop_gradient(inverse))
        return landmark[:2] + _direction(landmark[2]) / inverse

    def embed(self, pose: Pose, point: Point) -> Landmark:
        origin = self.frame(pose)[:2]
        distance, alpha = se2.polar(point - origin)
        inverse = 1.0 / jnp.maximum(distance, _NEAR)
        return jnp.stack([origin[0], origin[1], alpha, inverse])

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        v, axes = self._sight(frame, landmark)
        by_axes, by_v = se2.to_frame_jacobians(axes, v)
        outer = se2.polar_jacobians(se2.to_frame(axes, v))[0][1:]
        c, s = _direction(landmark[2])
        # ∂/∂(x, y, θ) of the direction in the sensor's frame, as rows: v = ρ(p0 - t) + …
        by_frame = jnp.stack([-landmark[3] * by_v[:, 0], -landmark[3] * by_v[:, 1], by_axes[:, 2]])
        by_alpha = by_v @ jnp.stack([-s, c])
        by_inverse = by_v @ (landmark[:2] - frame[:2])
        by_landmark = jnp.concatenate(
            [landmark[3] * by_v, by_alpha[:, None], by_inverse[:, None]], axis=1
        )
        return outer @ by_frame.T @ self.frame_jacobian(pose), outer @ by_landmark

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        eye = jnp.eye(4, dtype=pose.dtype)
        return eye[:, :3] @ self.frame_jacobian(pose), eye[:, 2:3], eye[:, 3:]

    def _ready(self, pose: Pose, landmark: Landmark, cov: Array) -> Array:
        inverse = jnp.where(landmark[3] > 0, landmark[3], 1.0)
        # v is along the line of sight, scaled by ρ: d = |v|/ρ, cos γ = v·(cos α, sin α)/|v|.
        v = landmark[3] * (landmark[:2] - self.frame(pose)[:2]) + _direction(landmark[2])
        square = v @ v
        along = jnp.abs(v @ _direction(landmark[2])) / jnp.where(square > 0, square, 1.0)
        index = 4 * jnp.sqrt(jnp.maximum(cov[3, 3], 0.0)) / inverse * along
        return (landmark[3] > 0) & (square > 0) & (index < jnp.asarray(self.to_point))


def _direction(alpha: Array) -> Array:
    return jnp.stack([jnp.cos(alpha), jnp.sin(alpha)])
