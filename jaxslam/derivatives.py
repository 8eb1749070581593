"""The Jacobians filters use: forward-mode automatic differentiation of the models.

The hand-derived Jacobians that models carry are for verification; a filter never reads them, so
that a user's own model needs none.
"""

import jax
import jax.numpy as jnp

from jaxslam.protocols import Motion, Sensor


def motion_jacobians(motion: Motion, pose: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """∂step/∂pose (3, 3) and ∂step/∂w (3, W) at w = 0 (Solà (13))."""
    w = jnp.zeros(len(motion.noises), pose.dtype)
    by_pose, by_noise = jax.jacfwd(motion.step, argnums=(0, 2))(pose, u, w)
    return by_pose, by_noise


def observe_jacobians(
    sensor: Sensor, pose: jax.Array, landmark: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """∂observe/∂pose (Z, 3) and ∂observe/∂l (Z, L) (Solà (25))."""
    by_pose, by_landmark = jax.jacfwd(sensor.observe, argnums=(0, 1))(pose, landmark)
    return by_pose, by_landmark


def invert_jacobians(
    sensor: Sensor, pose: jax.Array, z: jax.Array, s: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """∂invert/∂pose (L, 3), ∂invert/∂z (L, Z), ∂invert/∂s (L, K) (Solà (41)-(43))."""
    by_pose, by_z, by_s = jax.jacfwd(sensor.invert, argnums=(0, 1, 2))(pose, z, s)
    return by_pose, by_z, by_s
