"""The Euclidean error: differences of coordinates, with the heading wrapped."""

import jax.numpy as jnp
from jax import Array

from jaxslam.core.record import record
from jaxslam.math.angles import wrap
from jaxslam.math.arrays import Landmark, Pose
from jaxslam.protocols import Chart


@record
class Euclidean(Chart):
    """The chart of plain differences, dx = x - x₀ (θ wrapped), dl = l - l₀: Solà's error (22)."""

    def retract(
        self, pose: Pose, landmark: Landmark, dx: Pose, dl: Landmark
    ) -> tuple[Pose, Landmark]:
        return _wrap_heading(pose + dx), landmark + dl

    def local(
        self, pose0: Pose, landmark0: Landmark, pose: Pose, landmark: Landmark
    ) -> tuple[Pose, Landmark]:
        return _wrap_heading(pose - pose0), landmark - landmark0


def _wrap_heading(pose: Pose) -> Array:
    return jnp.concatenate([pose[:2], wrap(pose[2:])])
