"""A map from data against surveyed points, whose frame it does not share."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.math import se2
from jaxslam.types import Estimate


def align_map(estimate: Estimate, true_points: np.ndarray) -> tuple[np.ndarray, float]:
    """The pose (3,) that carries a map onto surveyed points best, and the RMSE [m] it leaves.

    estimate: of one time, landmarks tagged; true_points (N, 2) by tag. The frame of a map made from
    data is that of the robot's start, so only its shape can be compared (`se2.align`). Raises
    ValueError if the map is empty.
    """
    named = np.asarray(estimate.alive) & (np.asarray(estimate.tag) >= 0)
    if not named.any():
        raise ValueError("align_map: the map holds no tagged landmark")
    points = jnp.asarray(estimate.points)[named]
    targets = jnp.asarray(true_points, points.dtype)[np.asarray(estimate.tag)[named]]
    pose = se2.align(points, targets)
    left = jax.vmap(se2.from_frame, (None, 0))(pose, points) - targets
    return np.asarray(pose), float(jnp.sqrt((left**2).sum(axis=1).mean()))
