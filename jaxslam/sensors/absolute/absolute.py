"""Sensors of the robot's own state in the map, without a landmark."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

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


def absolute(
    name: str,
    measurements: tuple[str, ...],
    observe: Callable[[Pose], Measurement],
    residual: Callable[[Measurement, Measurement], Measurement],
    jacobian: Callable[[Pose], Float[Array, "Z 3"]],
    noise_cov: NoiseCov,
) -> Sensor:
    """The sensor z = h(pose) + v with L = 0; its `invert`, `embed` and `position` are not used.

    Args:
        observe, jacobian: (pose) -> z, and its derivative by the pose.
        residual: (z, z_hat) -> z ⊖ z_hat.
        noise_cov: (Z, Z) covariance of v, or a function of z.
    Raises:
        ValueError: if noise_cov is no such covariance.
    """
    size = len(measurements)

    def observe_jacobians(pose: Pose, landmark: Landmark) -> ObserveJacobians:
        return jacobian(pose), jnp.zeros((size, 0), pose.dtype)

    def invert(pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        return jnp.zeros(0, pose.dtype)

    def invert_jacobians(pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
        none = jnp.zeros((0, 3), pose.dtype)
        return none, none[:, :size], none[:, :0]

    return Sensor(
        name=name,
        measurements=measurements,
        observe=lambda pose, landmark: observe(pose),
        residual=residual,
        noise_cov=noise_model(name, noise_cov, size),
        invert=invert,
        landmark=(),
        position=lambda landmark: jnp.zeros(2, landmark.dtype),
        embed=lambda pose, point: jnp.zeros(0, pose.dtype),
        observe_jacobians=observe_jacobians,
        invert_jacobians=invert_jacobians,
    )
