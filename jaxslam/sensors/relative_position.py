"""The position of a landmark in the sensor's own frame, Cartesian."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.math.arrays import Pose
from jaxslam.noise import NoiseCov, noise_model
from jaxslam.protocols import Free, Sensor
from jaxslam.sensors.mounting import NO_OFFSET, mounting


def relative_position(noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET) -> Sensor:
    """z = (ahead [m], left [m]) of l = (x, y): R(θ_S)ᵀ(l - t_S) with S = pose ∘ mount; Solà (56).

    The measurement of Huang et al. 2010 and of UKF-M's 2-D SLAM example. invert is Solà (55).

    Args:
        noise_cov: (2, 2) covariance of z, or a function of z.
        mount: (3,) pose of the sensor on the robot, Solà's S.
    Raises:
        ValueError: if noise_cov is not a (2, 2) covariance or mount not a finite (3,).
    """
    sensor_pose, sensor_pose_jacobian = mounting("relative_position", mount)

    def observe(pose: Pose, landmark: Float[Array, "L"]) -> Float[Array, "Z"]:
        return se2.to_frame(sensor_pose(pose), landmark)

    def residual(z: Float[Array, "Z"], z_hat: Float[Array, "Z"]) -> Float[Array, "Z"]:
        return z - z_hat

    def invert(pose: Pose, z: Float[Array, "Z"], s: Float[Array, "K"]) -> Float[Array, "L"]:
        return se2.from_frame(sensor_pose(pose), z)

    def observe_jacobians(
        pose: Pose, landmark: Float[Array, "L"]
    ) -> tuple[Float[Array, "Z 3"], Float[Array, "Z L"]]:
        by_frame, by_point = se2.to_frame_jacobians(sensor_pose(pose), landmark)
        return by_frame @ sensor_pose_jacobian(pose), by_point

    def invert_jacobians(
        pose: Pose, z: Float[Array, "Z"], s: Float[Array, "K"]
    ) -> tuple[Float[Array, "L 3"], Float[Array, "L Z"], Float[Array, "L K"]]:
        by_frame, by_point = se2.from_frame_jacobians(sensor_pose(pose), z)
        return by_frame @ sensor_pose_jacobian(pose), by_point, jnp.zeros((2, 0), pose.dtype)

    return Sensor(
        name="relative_position",
        measurements=("ahead [m]", "left [m]"),
        landmark=("x [m]", "y [m]"),
        observe=observe,
        residual=residual,
        noise_cov=noise_model("relative_position", noise_cov, 2),
        invert=invert,
        position=lambda landmark: landmark,
        embed=lambda pose, point: point,
        free=Free(jnp.zeros(0), jnp.zeros((0, 0))),
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
