"""The Jacobians filters use: forward-mode automatic differentiation of the models.

The hand-derived Jacobians of models are for verification; filters do not use them, so a
user's own model needs none.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxslam.math.arrays import (
    Control,
    InvertJacobians,
    Landmark,
    Measurement,
    ObserveJacobians,
    Pose,
    PoseMatrix,
    Unmeasured,
)
from jaxslam.protocols import Motion, Sensor


def motion_jacobians(
    motion: Motion, pose: Pose, u: Control
) -> tuple[PoseMatrix, Float[Array, "3 W"]]:
    """The Jacobians F, W of a motion, ∂step/∂pose and ∂step/∂w at w = 0 (Solà (13))."""
    w = jnp.zeros(len(motion.noises), pose.dtype)
    by_pose, by_noise = jax.jacfwd(motion.step, argnums=(0, 2))(pose, u, w)
    return by_pose, by_noise


def observe_jacobians(sensor: Sensor, pose: Pose, landmark: Landmark) -> ObserveJacobians:
    """The Jacobians H of a measurement, ∂observe/∂pose and ∂observe/∂l (Solà (25))."""
    by_pose, by_landmark = jax.jacfwd(sensor.observe, argnums=(0, 1))(pose, landmark)
    return by_pose, by_landmark


def invert_jacobians(sensor: Sensor, pose: Pose, z: Measurement, s: Unmeasured) -> InvertJacobians:
    """The Jacobians G of a new landmark by pose, z and s, ∂invert/∂… (Solà (41)-(43))."""
    by_pose, by_z, by_s = jax.jacfwd(sensor.invert, argnums=(0, 1, 2))(pose, z, s)
    return by_pose, by_z, by_s
