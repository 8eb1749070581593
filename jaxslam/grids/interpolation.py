"""Bilinear interpolation in a field, differentiable by the point."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.grids.grid import Field, to_cells


def interpolate(field: Field, points: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """The values of a field at points of the world [m], bilinear between centres of cells.

    Off the map, and within half a cell of its border, the value is that of the nearest point of the
    rectangle of centres: continuous everywhere, and the gradient by a point is finite everywhere;
    across the border it is zero. At a line between four centres the gradient is of one side.
    """
    return interpolated(field.values, to_cells(field.origin, field.resolution, points) - 0.5)


def interpolated(values: Float[Array, "H W"], at: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """The bilinear interpolation of a table at (x, y) = (column, row) coordinates.

    f = a (1-u)(1-v) + b u (1-v) + c (1-u) v + d u v on the unit square of the four entries around.
    """
    height, width = values.shape
    values = jnp.asarray(values)
    x, y = jnp.clip(at[..., 0], 0, width - 1), jnp.clip(at[..., 1], 0, height - 1)
    j = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, max(width - 2, 0))
    i = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, max(height - 2, 0))
    right, up = jnp.minimum(j + 1, width - 1), jnp.minimum(i + 1, height - 1)
    u, v = x - j, y - i
    a, b, c, d = values[i, j], values[i, right], values[up, j], values[up, right]
    bottom, top = a + u * (b - a), c + u * (d - c)
    return bottom + v * (top - bottom)
