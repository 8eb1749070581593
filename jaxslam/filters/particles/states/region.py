"""Where a robot may be: the places that a start from anywhere, and recovery, draw poses from."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.core.numbers import held_array, is_concrete
from jaxslam.core.record import record, set_field
from jaxslam.math.angles import wrap


class Region:
    """A set of places in the plane, each with any heading; a subclass is a record."""

    def draw(self, count: int, key: Array, dtype: DTypeLike) -> Float[Array, "P 3"]:
        """Poses drawn uniformly in it."""
        raise NotImplementedError

    def moments(self, dtype: DTypeLike) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """The mean and the covariance of a pose drawn."""
        raise NotImplementedError


@record
class Box(Region):
    """A box, rows its lowest and highest (x, y) [m]."""

    ends: ArrayLike

    def draw(self, count: int, key: Array, dtype: DTypeLike) -> Float[Array, "P 3"]:
        return draw_uniform_poses(jnp.asarray(self.ends, dtype), count, key)

    def moments(self, dtype: DTypeLike) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        return uniform_pose_moments(jnp.asarray(self.ends, dtype))


def hold_box(filter: Any) -> None:
    """Check and hold the field box (2, 2) of a filter, in `__post_init__`.

    Raises ValueError, which begins with its class, where it is not finite or has no inside.
    """
    if filter.box is None:
        return
    ends = held_array(filter.box)
    values = np.asarray(ends) if is_concrete(ends) else None
    good = np.shape(ends) == (2, 2)
    if values is not None:
        good = good and bool(np.isfinite(values).all() and (values[1] > values[0]).all())
    if not good:
        raise ValueError(
            f"{type(filter).__name__}: expected a box of shape (2, 2), its lowest and highest "
            f"(x, y), got {filter.box!r}"
        )
    set_field(filter, "box", ends)


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
