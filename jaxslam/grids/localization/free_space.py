"""The free cells of a map as the region where a robot may be."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.core.record import record
from jaxslam.filters.particles.pose_particles import Region
from jaxslam.grids.grid import Grid
from jaxslam.math.angles import wrap


@record
class FreeSpace(Region):
    """The free cells of a map."""

    places: ArrayLike
    """(K, 2) their centres"""
    sides: ArrayLike
    """(2, 2) of a cell, as rows"""

    def draw(self, count: int, key: Array, dtype: DTypeLike) -> Float[Array, "P 3"]:
        key_which, key_where = jax.random.split(key)
        places = jnp.asarray(self.places, dtype)
        which = jax.random.randint(key_which, (count,), 0, len(places))
        share = jax.random.uniform(key_where, (count, 3), dtype) - 0.5
        place = places[which] + share[:, :2] @ jnp.asarray(self.sides, dtype)
        return jnp.concatenate([place, wrap(2 * math.pi * share[:, 2:])], axis=1)

    def moments(self, dtype: DTypeLike) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        places, sides = jnp.asarray(self.places, dtype), jnp.asarray(self.sides, dtype)
        mean = places.mean(axis=0)
        spread = (places - mean[None]).T @ (places - mean[None]) / len(
            places
        ) + sides.T @ sides / 12
        cov = jnp.zeros((3, 3), dtype).at[:2, :2].set(spread).at[2, 2].set(math.pi**2 / 3)
        return jnp.concatenate([mean, jnp.zeros(1, dtype)]), cov


def free_space(name: str, grid: Grid, box: Float[np.ndarray, "2 2"] | None) -> FreeSpace:
    """The free cells of a map whose centres lie in a box, None for all.

    Raises ValueError, which begins with a caller's name, where there is none.
    """
    free = np.asarray(grid.log_odds) < 0
    if not free.any():
        raise ValueError(f"{name}: the map has no free cell (log-odds below 0)")
    origin, cell = np.asarray(grid.origin, np.float64), float(np.asarray(grid.resolution))
    c, s = np.cos(origin[2]), np.sin(origin[2])
    sides = cell * np.array([[c, s], [-s, c]])
    i, j = np.indices(free.shape) + 0.5
    middle = np.stack([j, i], axis=-1) @ sides + origin[:2]
    if box is not None:
        free = free & ((middle >= box[0]) & (middle <= box[1])).all(axis=2)
        if not free.any():
            raise ValueError(f"{name}: no free cell of the map is in the box {box.tolist()}")
    return FreeSpace(middle[free], sides)
