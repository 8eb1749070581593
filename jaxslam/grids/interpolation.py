"""Bilinear interpolation in a field, differentiable by the point."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.grids.grid import Field, to_cells


def interpolate(field: Field, points: ArrayLike) -> Float[Array, "*n"]:
    """The values of a field at points (..., 2) of the world [m], bilinear between centres of cells.

    Off the map, and within half a cell of its border, the value is that of the nearest point of the
    rectangle of centres: continuous everywhere, and the gradient by a point is finite everywhere;
    across the border it is zero. At a line between four centres the gradient is of one side.

    Raises ValueError on what is no field, and on points of a shape other than (..., 2).
    """
    if not isinstance(field, Field):
        raise ValueError(f"interpolate: expected a Field, got a {type(field).__name__}")
    points = jnp.asarray(points)
    if points.ndim == 0 or points.shape[-1] != 2:
        raise ValueError(f"interpolate: expected points (x, y), got shape {points.shape}")
    return interpolated(field.values, to_cells(field.origin, field.resolution, points) - 0.5)


def interpolated(values: Float[Array, "H W"], at: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """The bilinear interpolation of a table at (x, y) = (column, row) coordinates.

    f = a (1-u)(1-v) + b u (1-v) + c (1-u) v + d u v on the unit square of the four entries around.
    """
    (a, b, c, d), (u, v) = _around(values, at)
    bottom, top = a + u * (b - a), c + u * (d - c)
    return bottom + v * (top - bottom)


def slope(field: Field, points: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """The gradient of `interpolate` by the point, in the world's x and y, derived by hand.

    ∂f/∂u = (b - a)(1-v) + (d - c) v and ∂f/∂v = (c - a)(1-u) + (d - b) u, over the resolution and
    turned by the heading of the grid; 0 along an axis on which the point is off the centres.
    """
    at = to_cells(field.origin, field.resolution, points) - 0.5
    (a, b, c, d), (u, v) = _around(field.values, at)
    height, width = field.values.shape
    x, y = at[..., 0], at[..., 1]
    along = jnp.where((x >= 0) & (x <= width - 1), (b - a) * (1 - v) + (d - c) * v, 0.0)
    across = jnp.where((y >= 0) & (y <= height - 1), (c - a) * (1 - u) + (d - b) * u, 0.0)
    along, across = along / field.resolution, across / field.resolution
    cos, sin = jnp.cos(field.origin[2]), jnp.sin(field.origin[2])
    return jnp.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)


def _around(
    values: Float[Array, "H W"], at: Float[Array, "*n 2"]
) -> tuple[tuple[Array, Array, Array, Array], tuple[Array, Array]]:
    """The four entries a, b, c, d around (x, y), and where between them it is: (u, v)."""
    height, width = values.shape
    values = jnp.asarray(values)
    x, y = jnp.clip(at[..., 0], 0, width - 1), jnp.clip(at[..., 1], 0, height - 1)
    j = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, max(width - 2, 0))
    i = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, max(height - 2, 0))
    right, up = jnp.minimum(j + 1, width - 1), jnp.minimum(i + 1, height - 1)
    entries = values[i, j], values[i, right], values[up, j], values[up, right]
    return entries, (x - j, y - i)
