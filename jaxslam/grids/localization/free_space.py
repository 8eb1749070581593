"""The free cells of a map as the region where a robot may be."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from jaxslam.filters.particles.states.region import Region
from jaxslam.grids.grid import Grid
from jaxslam.math.angles import wrap


def free_region(name: str, grid: Grid, box: Float[np.ndarray, "2 2"] | None) -> Region:
    """The region of the free cells of a map whose centres lie in a box, None for all.

    Raises ValueError, which begins with a caller's name, where there is none.
    """
    free = np.asarray(grid.log_odds) < 0
    if not free.any():
        raise ValueError(f"{name}: the map has no free cell (log-odds below 0)")
    origin, cell = np.asarray(grid.origin, np.float64), float(np.asarray(grid.resolution))
    c, s = np.cos(origin[2]), np.sin(origin[2])
    sides = cell * np.array([[c, s], [-s, c]])  # of a cell, as rows
    i, j = np.indices(free.shape) + 0.5
    middle = np.stack([j, i], axis=-1) @ sides + origin[:2]
    if box is not None:
        free = free & ((middle >= box[0]) & (middle <= box[1])).all(axis=2)
        if not free.any():
            raise ValueError(f"{name}: no free cell of the map is in the box {box.tolist()}")
    places = middle[free]
    mean = np.array([*places.mean(axis=0), 0.0])
    cov = np.zeros((3, 3))
    cov[:2, :2] = np.cov(places.T, bias=True) + sides.T @ sides / 12
    cov[2, 2] = math.pi**2 / 3

    def draw(size: int, key: Array, dtype: DTypeLike) -> Float[Array, "P 3"]:
        key_which, key_where = jax.random.split(key)
        which = jax.random.randint(key_which, (size,), 0, len(places))
        share = jax.random.uniform(key_where, (size, 3), dtype) - 0.5
        offset = share[:, :2] @ jnp.asarray(sides, dtype)
        place = jnp.asarray(places, dtype)[which] + offset
        return jnp.concatenate([place, wrap(2 * math.pi * share[:, 2:])], axis=1)

    def moments(dtype: DTypeLike) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        return jnp.asarray(mean, dtype), jnp.asarray(cov, dtype)

    return Region(draw, moments)
