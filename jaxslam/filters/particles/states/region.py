"""Where a robot may be: the places that a start from anywhere, and recovery, draw poses from."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from jaxslam.math.angles import wrap


@dataclass(frozen=True, eq=False)
class Region:
    """A set of places in the plane, each with any heading."""

    draw: Callable[[int, Array, DTypeLike], Array]
    """(count, key, dtype) -> (count, 3) poses, uniform in it"""
    moments: Callable[[DTypeLike], tuple[Array, Array]]
    """(dtype) -> mean (3,) and covariance (3, 3) of a pose drawn"""


def box_region(box: Float[np.ndarray, "2 2"]) -> Region:
    """The region of a box, rows its lowest and highest (x, y) [m]."""
    return Region(
        draw=lambda count, key, dtype: draw_uniform_poses(jnp.asarray(box, dtype), count, key),
        moments=lambda dtype: uniform_pose_moments(jnp.asarray(box, dtype)),
    )


def draw_uniform_poses(box: Float[Array, "2 2"], count: int, key: Array) -> Float[Array, "P 3"]:
    """Poses drawn uniformly in a box, rows its lowest and highest (x, y), with any heading."""
    share = jax.random.uniform(key, (count, 3), box.dtype)
    low, high = box[0][None], box[1][None]
    heading = wrap(2 * math.pi * share[:, 2:])
    return jnp.concatenate([low + (high - low) * share[:, :2], heading], axis=1)


def uniform_pose_moments(
    box: Float[Array, "2 2"],
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Mean and covariance of `draw_uniform_poses`; the heading, uniform, gets 0 ± π/√3."""
    width = box[1] - box[0]
    mean = jnp.concatenate([0.5 * (box[0] + box[1]), jnp.zeros(1, box.dtype)])
    variance = jnp.concatenate([width**2, jnp.full(1, 4 * math.pi**2, box.dtype)]) / 12
    return mean, jnp.diag(variance)
