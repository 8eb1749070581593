"""Range and bearing of a point landmark, from a laser scanner or a sonar."""

import jax.numpy as jnp
from jax import Array
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
class RangeBearing(Sensor):
    """The range-bearing sensor of point landmarks.

    z = (range [m], bearing [rad]) of l = (x, y): polar(to_frame(pose ∘ mount, l)), Solà (63).

    invert is (64), from_frame(pose ∘ mount, rectangular(z)) (in the sensor's frame: errata).
    A landmark exactly at the sensor gives z = 0 with zero derivative by l, not NaN.
    """

    noise_cov: NoiseCov
    """(2, 2) covariance of (range, bearing), or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot, Solà's S"""
    measurements = ("range [m]", "bearing [rad]")
    equations = (
        "range = sqrt((l_x - x_s)**2 + (l_y - y_s)**2) + n_range\n"
        "bearing = wrap(atan2(l_y - y_s, l_x - x_s) - theta_s + n_bearing)"
    )

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        return se2.polar_in_frame(self.frame(pose), landmark)

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(self.frame(pose), se2.rectangular(z))

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        # The chain of polar ∘ to_frame ∘ (pose ∘ mount).
        (outer,) = se2.polar_jacobians(se2.to_frame(frame, landmark))
        return outer @ by_frame @ self.frame_jacobian(pose), outer @ by_point

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        frame = self.frame(pose)
        by_frame, by_point = se2.from_frame_jacobians(frame, se2.rectangular(z))
        (inner,) = se2.rectangular_jacobians(z)
        by_s = jnp.zeros((2, 0), pose.dtype)
        return by_frame @ self.frame_jacobian(pose), by_point @ inner, by_s


@record
class RangeBearingNoise:
    """The diagonal covariance of (range, bearing), a function z -> (2, 2).

        var r = range² + (share r)²,    var φ = bearing² + across² / (r² + across²)

    `across` is the standard deviation with which the place of a landmark is seen across the line
    of sight, as on a post that is wider than a beam; at the sensor its bearing says nothing.
    """

    range: ArrayLike
    """[m] standard deviation"""
    bearing: ArrayLike
    """[rad] standard deviation"""
    share: ArrayLike = 0.0
    """[1] standard deviation of the range, as a share of the range"""
    across: ArrayLike = 0.0
    """[m] standard deviation of the place across the line of sight"""
    equations = (
        "# range and bearing are the numbers above, standard deviations; r is the range without\n"
        "# noise, in a filter the predicted one; 0/0 is 0\n"
        "variance_of_n_range = range**2 + (share*r)**2\n"
        "variance_of_n_bearing = bearing**2 + across**2/(r**2 + across**2)"
    )

    def __call__(self, z: Measurement) -> Array:
        range, bearing, share, across = (
            jnp.asarray(value, z.dtype)
            for value in (self.range, self.bearing, self.share, self.across)
        )
        square = z[0] ** 2 + across**2
        # Without `across`, at the sensor, 0/0.
        apart = jnp.where(square > 0, across**2 / jnp.where(square > 0, square, 1.0), 0.0)
        return jnp.diag(jnp.stack([range**2 + (share * z[0]) ** 2, bearing**2 + apart]))
