"""Range, bearing and signature of a landmark; a signature is a reflectivity or a diameter."""

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
class RangeBearingSignature(Sensor):
    """The range-bearing sensor of landmarks with a signature.

    z = (range [m], bearing [rad], signature [1]) of l = (x, y, signature): D = 3 + 3N.

    polar(to_frame(pose ∘ mount, (x, y))) as in `RangeBearing`, and the signature unchanged: the
    landmarks with three parameters of Tacher. The signature is estimated like a coordinate; an
    association method may use it to recognize landmarks. embed gives a signature of 0. A landmark
    exactly at the sensor gives z = (0, 0, signature), not NaN.
    """

    noise_cov: NoiseCov
    """(3, 3) covariance of (range, bearing, signature), or a function of z."""
    mount: ArrayLike | None = None
    """(3,) pose of the sensor on the robot, Solà's S"""
    measurements = ("range [m]", "bearing [rad]", "signature [1]")
    landmark = ("x [m]", "y [m]", "signature [1]")
    equations = (
        "range = sqrt((l_x - x_s)**2 + (l_y - y_s)**2) + n_range\n"
        "bearing = wrap(atan2(l_y - y_s, l_x - x_s) - theta_s + n_bearing)\n"
        "signature = l_signature + n_signature"
    )

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        seen = se2.polar(se2.to_frame(self.frame(pose), landmark[:2]))
        return jnp.concatenate([seen, landmark[2:]])

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        point = se2.from_frame(self.frame(pose), se2.rectangular(z[:2]))
        return jnp.concatenate([point, z[2:]])

    def observe_jacobians(self, pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = self.frame(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark[:2])
        (outer,) = se2.polar_jacobians(se2.to_frame(frame, landmark[:2]))
        by_pose = jnp.zeros((3, 3), pose.dtype)
        by_pose = by_pose.at[:2].set(outer @ by_frame @ self.frame_jacobian(pose))
        return by_pose, _beside_one(outer @ by_point)

    def invert_jacobians(self, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        by_frame, by_point = se2.from_frame_jacobians(self.frame(pose), se2.rectangular(z[:2]))
        (inner,) = se2.rectangular_jacobians(z[:2])
        by_pose = jnp.zeros((3, 3), pose.dtype)
        by_pose = by_pose.at[:2].set(by_frame @ self.frame_jacobian(pose))
        return by_pose, _beside_one(by_point @ inner), jnp.zeros((3, 0), pose.dtype)


def _beside_one(block: Array) -> Array:
    """The matrix diag(block, 1), (3, 3)."""
    return jnp.eye(3, dtype=block.dtype).at[:2, :2].set(block)
