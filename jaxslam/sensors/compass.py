"""The robot's heading in the map: a compass, a sun sensor."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.math.angles import wrap
from jaxslam.math.arrays import Pose
from jaxslam.noise import NoiseCov, noise_model
from jaxslam.protocols import Free, Sensor
from jaxslam.sensors.mounting import NO_OFFSET, mounting


def compass(noise_cov: NoiseCov, mount: ArrayLike = NO_OFFSET) -> Sensor:
    """z = (heading [rad]) = wrap(θ + θ_mount), counter-clockwise from the map's x-axis.

    An absolute sensor (Williams' list of observations): there is no landmark, L = 0, and `invert`,
    `embed` and `position` (zeros) only complete the record; nothing reads them.

    Args:
        noise_cov: (1, 1) covariance of the heading, or a function of z.
        mount: (3,) pose of the sensor on the robot; only its angle matters.
    Raises:
        ValueError: if noise_cov is not a (1, 1) covariance or mount not a finite (3,).
    """
    sensor_pose, sensor_pose_jacobian = mounting("compass", mount)

    def observe(pose: Pose, landmark: Float[Array, "L"]) -> Float[Array, "Z"]:
        return sensor_pose(pose)[2:]

    def residual(z: Float[Array, "Z"], z_hat: Float[Array, "Z"]) -> Float[Array, "Z"]:
        return wrap(z - z_hat)

    def invert(pose: Pose, z: Float[Array, "Z"], s: Float[Array, "K"]) -> Float[Array, "L"]:
        return jnp.zeros(0, pose.dtype)

    def observe_jacobians(
        pose: Pose, landmark: Float[Array, "L"]
    ) -> tuple[Float[Array, "Z 3"], Float[Array, "Z L"]]:
        return sensor_pose_jacobian(pose)[2:], jnp.zeros((1, 0), pose.dtype)

    def invert_jacobians(
        pose: Pose, z: Float[Array, "Z"], s: Float[Array, "K"]
    ) -> tuple[Float[Array, "L 3"], Float[Array, "L Z"], Float[Array, "L K"]]:
        none = jnp.zeros((0, 3), pose.dtype)
        return none, none[:, :1], none[:, :0]

    return Sensor(
        name="compass",
        measurements=("heading [rad]",),
        landmark=(),
        observe=observe,
        residual=residual,
        noise_cov=noise_model("compass", noise_cov, 1),
        invert=invert,
        position=lambda landmark: jnp.zeros(2, landmark.dtype),
        embed=lambda pose, point: jnp.zeros(0, pose.dtype),
        free=Free(jnp.zeros(0), jnp.zeros((0, 0))),
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
