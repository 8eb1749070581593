"""The textbook error: differences of coordinates, heading wrapped."""

import jax
import jax.numpy as jnp

from jaxslam.math.angles import wrap
from jaxslam.protocols import Chart


def euclidean() -> Chart:
    """dx = (x, y, wrap θ) - (x, y, θ)₀ and dl = l - l₀: the error of Solà's EKF-SLAM (22)."""

    def retract(
        pose: jax.Array, landmark: jax.Array, dx: jax.Array, dl: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        return _wrap_heading(pose + dx), landmark + dl

    def local(
        pose0: jax.Array, landmark0: jax.Array, pose: jax.Array, landmark: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        return _wrap_heading(pose - pose0), landmark - landmark0

    return Chart(name="euclidean", retract=retract, local=local)


def _wrap_heading(pose: jax.Array) -> jax.Array:
    return jnp.concatenate([pose[:2], wrap(pose[2:])])
