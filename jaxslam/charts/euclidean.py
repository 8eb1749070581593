"""The textbook error: differences of coordinates, heading wrapped."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxslam.math.angles import wrap
from jaxslam.math.arrays import Pose
from jaxslam.protocols import Chart


def euclidean() -> Chart:
    """dx = (x, y, wrap θ) - (x, y, θ)₀ and dl = l - l₀: the error of Solà's EKF-SLAM (22)."""

    def retract(
        pose: Pose, landmark: Float[Array, "L"], dx: Pose, dl: Float[Array, "L"]
    ) -> tuple[Pose, Float[Array, "L"]]:
        return _wrap_heading(pose + dx), landmark + dl

    def local(
        pose0: Pose, landmark0: Float[Array, "L"], pose: Pose, landmark: Float[Array, "L"]
    ) -> tuple[Pose, Float[Array, "L"]]:
        return _wrap_heading(pose - pose0), landmark - landmark0

    return Chart(name="euclidean", retract=retract, local=local)


def _wrap_heading(pose: Pose) -> Array:
    return jnp.concatenate([pose[:2], wrap(pose[2:])])
