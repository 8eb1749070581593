"""The error of a map whose frame is not that of the surveyed points it is compared with."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.math import se2
from jaxslam.types import Estimate


def align_map(
    estimate: Estimate, true_points: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """The pose that carries a map onto surveyed points best, and the RMSE [m] that remains.

    estimate: of one time, landmarks tagged. true_points: by tag. The frame of a map made from
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
