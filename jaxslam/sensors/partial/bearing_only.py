"""Bearing of a point landmark, without its range: a camera, a radio direction finder."""

import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.math.angles import wrap
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

TEN_METRES = ((10.0,), ((25.0,),))
"""Range 10 m, σ 5 m: a placeholder for the actual prior knowledge."""


def bearing_only(
    noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET, free: FreeLike = TEN_METRES
) -> Sensor:
    """The bearing-only sensor of point landmarks.

    z = (bearing [rad]) of l = (x, y): the direction of R(θ_S)ᵀ(l - t_S), S = pose ∘ mount.

    The second row of Solà (63). invert is (64) with s = (range [m]) for the unmeasured coordinate:
    from_frame(S, rectangular((s, z))), s > 0; a negative range lies behind the sensor. A landmark
    exactly at the sensor gives z = 0 with zero derivatives, not NaN.

    Choose the prior for your application. The range has no upper bound, the bearing is strongly
    nonlinear in it, and an EKF linearizes once over the whole prior. A narrow prior may be wrong;
    with a wide one the linearization error makes the filter diverge (Solà 2.3.5). Landmarks
    initialized by inverse distance avoid this conflict: see `bearing_inverse_depth`.

    Args:
        noise_cov: (1, 1) covariance of the bearing, or a function of z.
        mount: (3,) pose of the sensor on the robot, Solà's S.
        free: mean (1,) and covariance (1, 1) of the range [m], Solà (39).
    Raises:
        ValueError: if noise_cov is not a (1, 1) covariance, mount not a finite (3,) or free not a
            Gaussian of positive variance.
    """
    sensor_pose, sensor_pose_jacobian = mounting("bearing_only", mount)

    def observe(pose: Pose, landmark: Landmark) -> Measurement:
        return se2.polar_in_frame(sensor_pose(pose), landmark)[1:]

    def residual(z: Measurement, z_hat: Measurement) -> Measurement:
        return wrap(z - z_hat)

    def invert(pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return se2.from_frame(sensor_pose(pose), se2.rectangular(jnp.concatenate([s, z])))

    def observe_jacobians(pose: Pose, landmark: Landmark) -> ObserveJacobians:
        frame = sensor_pose(pose)
        by_frame, by_point = se2.to_frame_jacobians(frame, landmark)
        outer = se2.polar_jacobians(se2.to_frame(frame, landmark))[0][1:]
        return outer @ by_frame @ sensor_pose_jacobian(pose), outer @ by_point

    def invert_jacobians(pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        frame, seen = sensor_pose(pose), jnp.concatenate([s, z])
        by_frame, by_point = se2.from_frame_jacobians(frame, se2.rectangular(seen))
        by_polar = by_point @ se2.rectangular_jacobians(seen)[0]
        return by_frame @ sensor_pose_jacobian(pose), by_polar[:, 1:], by_polar[:, :1]

    return Sensor(
        name="bearing_only",
        measurements=("bearing [rad]",),
        observe=observe,
        residual=residual,
        noise_cov=noise_model("bearing_only", noise_cov, 1),
        invert=invert,
        free=free_parameters("bearing_only", free, 1),
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
