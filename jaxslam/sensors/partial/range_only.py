"""Range of a point landmark, without its bearing: a radio beacon, a sonar's echo."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.math.arrays import (
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Pose,
    Unmeasured,
)
from jaxslam.noise import NoiseCov, noise_model
from jaxslam.protocols import Sensor
from jaxslam.sensors.mounting import NO_OFFSET, mounting
from jaxslam.sensors.partial.prior import FreeLike, free_parameters

ANY_DIRECTION = ((0.0,), ((np.pi**2 / 3,),))
"""The Gaussian with the mean and the variance of a direction uniform on (-π, π]."""


def range_only(
    noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET, free: FreeLike = ANY_DIRECTION
) -> Sensor:
    """The range-only sensor of point landmarks.

    z = (range [m]) of l = (x, y): |l - t_S| with S = pose ∘ mount, the first row of Solà (63).

    invert is (64) with s = (bearing [rad]) in the sensor's frame for the unmeasured coordinate:
    from_frame(S, rectangular((z, s))), z >= 0. A landmark exactly at the sensor gives z = 0 with
    zero derivatives, not NaN.

    One Gaussian in x and y cannot represent a ring. With the default prior the linearized landmark
    is an ellipse along the ring's tangent ahead of the sensor, and a filter that starts from it is
    inconsistent; give a narrower prior where one is known.

    Args:
        noise_cov: (1, 1) covariance of the range, or a function of z.
        mount: (3,) pose of the sensor on the robot, Solà's S.
        free: mean (1,) and covariance (1, 1) of the bearing [rad], Solà (39).
    Raises:
        ValueError: if noise_cov is not a (1, 1) covariance, mount not a finite (3,) or free not a
            Gaussian of positive variance.
    """
    sensor_pose, sensor_pose_jacobian = mounting("range_only", mount)

    def observe(pose: Pose, landmark: Landmark) -> Measurement:
        return se2.polar_in_frame(sensor_pose(pose), landmark)[:1]

    def residual(z: Measurement, z_hat: Measurement) -> Measurement:
        return z - z_hat

    def invert(pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(sensor_pose(pose), se2.rectangular(jnp.concatenate([z, s])))

    def observe_jacobians(pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = sensor_pose(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        outer = se2.polar_jacobians(se2.to_frame(frame, landmark))[0][:1]
        return outer @ by_frame @ sensor_pose_jacobian(pose), outer @ by_point

    def invert_jacobians(pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        frame, seen = sensor_pose(pose), jnp.concatenate([z, s])
        by_frame, by_point = se2.from_frame_jacobians(frame, se2.rectangular(seen))
        by_polar = by_point @ se2.rectangular_jacobians(seen)[0]
        return by_frame @ sensor_pose_jacobian(pose), by_polar[:, :1], by_polar[:, 1:]

    return Sensor(
        name="range_only",
        measurements=("range [m]",),
        observe=observe,
        residual=residual,
        noise_cov=noise_model("range_only", noise_cov, 1),
        invert=invert,
        free=free_parameters("range_only", free, 1),
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
