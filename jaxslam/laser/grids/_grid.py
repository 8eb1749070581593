"""The data of a grid map and of a field over one: coordinates, interpolation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxslam.core._numbers import check_real, is_concrete, shape_text
from jaxslam.core._reprs import short_repr
from jaxslam.core.types import JaxOrNumPy
from jaxslam.math import se2


class Grid(NamedTuple):
    """An occupancy grid: log-odds of H × W cells, the pose of its lower left corner, cell size.

    A log-odds of exactly 0 is *unknown*: no evidence for occupied or free. What sums evidence keeps
    it exactly 0 where nothing was measured. Evidence that cancels exactly is unknown as well, since
    it has no information on the cell; counts (`grids.Counts`) distinguish the two.
    """

    log_odds: Float[JaxOrNumPy, "H W"]
    """log p/(1 - p), p the probability that a cell is occupied; finite"""
    origin: Float[JaxOrNumPy, "3"]
    """pose of the lower left corner of cell (0, 0) in the world"""
    resolution: Float[JaxOrNumPy, ""]
    """side of a cell [m]"""

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def probability(self) -> Float[Array, "H W"]:
        """The probability p = 1/(1 + exp(-log-odds)) that a cell is occupied; ½ if unknown."""
        return jax.nn.sigmoid(self.log_odds)

    @property
    def observed(self) -> Bool[JaxOrNumPy, "H W"]:
        """Mask of the cells with evidence: their log-odds are not 0."""
        return self.log_odds != 0


class Field(NamedTuple):
    """Numbers at the centres of the cells of a grid, as of a distance field."""

    values: Float[Array, "H W"]
    origin: Float[Array, "3"]
    resolution: Float[Array, ""]


def to_cells(
    origin: Float[Array, "3"], resolution: ArrayLike, points: Float[Array, "*n 2"]
) -> Float[Array, "*n 2"]:
    """World points p [m] as continuous coordinates (x, y) in cells: R(θ)ᵀ(p - t)/resolution."""
    c, s = jnp.cos(origin[2]), jnp.sin(origin[2])
    dx, dy = points[..., 0] - origin[0], points[..., 1] - origin[1]
    return jnp.stack([c * dx + s * dy, -s * dx + c * dy], axis=-1) / resolution


def centers(grid: Grid | Field) -> Float[Array, "H W 2"]:
    """The centres of the cells in the world [m]."""
    height, width = grid[0].shape
    y, x = jnp.meshgrid(jnp.arange(height) + 0.5, jnp.arange(width) + 0.5, indexing="ij")
    local = grid.resolution * jnp.stack([x, y], axis=-1)
    origin = jnp.asarray(grid.origin)
    return jnp.einsum("ab,hwb->hwa", se2.rotation(origin[2]), local) + origin[None, None, :2]


def check_grid(name: str, grid: object) -> None:
    """Raise ValueError, which begins with a caller's name, unless the grid is one.

    Refused are log-odds other than a finite array of floats of at least one cell, an origin that is
    no pose, and a resolution that is not above 0. Within a trace only shapes are checked.
    """
    if not isinstance(grid, Grid):
        raise ValueError(f"{name}: expected a Grid, got {type(grid).__name__}")
    if not hasattr(grid.log_odds, "dtype") or not jnp.issubdtype(grid.log_odds.dtype, np.floating):
        kind = getattr(grid.log_odds, "dtype", f"a {type(grid.log_odds).__name__}")
        raise ValueError(f"{name}: expected log-odds in an array of floats, got {kind}")
    if np.ndim(grid.log_odds) != 2 or 0 in np.shape(grid.log_odds):
        raise ValueError(
            f"{name}: expected log-odds of shape (at least 1, at least 1), "
            f"got {shape_text(grid.log_odds)}"
        )
    check_frame(name, grid.origin, grid.resolution)
    if is_concrete(grid.log_odds) and not np.all(np.isfinite(grid.log_odds)):
        raise ValueError(f"{name}: expected finite log-odds; unknown is 0")


def check_frame(name: str, origin: ArrayLike, resolution: ArrayLike) -> None:
    """Raise ValueError unless origin is a pose, and resolution a finite number above 0."""
    check_real(name, origin=origin, resolution=resolution)
    if np.shape(origin) != (3,):
        raise ValueError(
            f"{name}: expected an origin that is a pose (x, y, θ), got {shape_text(origin)}"
        )
    if np.shape(resolution) != ():
        raise ValueError(f"{name}: expected one resolution, got {shape_text(resolution)}")
    if not is_concrete(origin, resolution):
        return
    if not np.all(np.isfinite(origin)):
        raise ValueError(f"{name}: expected a finite origin, got {np.asarray(origin)}")
    if not 0 < float(np.asarray(resolution)) < np.inf:
        raise ValueError(f"{name}: expected a resolution above 0, got {resolution}")


def interpolate(field: Field, points: ArrayLike) -> Float[Array, "*n"]:
    """The values of a field at points (..., 2) of the world [m], bilinear between centres of cells.

    Off the map, and within half a cell of its border, the value is that of the nearest point of the
    rectangle of centres: continuous everywhere, and the gradient by a point is finite everywhere;
    across the border it is zero. At a line between four centres the gradient is of one side.

    Raises ValueError on other types than fields, and on points of a shape other than (..., 2).
    """
    if not isinstance(field, Field):
        raise ValueError(f"interpolate: expected a Field, got a {type(field).__name__}")
    points = jnp.asarray(points)
    if points.ndim == 0 or points.shape[-1] != 2:
        raise ValueError(f"interpolate: expected points (x, y), got shape {points.shape}")
    # Half a cell: entry (i, j) is the value at the centre (j + ½, i + ½).
    return interpolate_cells(field.values, to_cells(field.origin, field.resolution, points) - 0.5)


def interpolate_cells(values: Float[Array, "H W"], at: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """The bilinear interpolation of a table at (x, y) = (column, row) coordinates.

    f = a (1-u)(1-v) + b u (1-v) + c (1-u) v + d u v on the unit square of the four entries around.
    """
    (a, b, c, d), (u, v) = _around(values, at)
    # By differences: a constant field stays constant to the last bit.
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
    # The last but one at most, so that there is an entry to the right, unless there is only one.
    j = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, max(width - 2, 0))
    i = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, max(height - 2, 0))
    right, up = jnp.minimum(j + 1, width - 1), jnp.minimum(i + 1, height - 1)
    entries = values[i, j], values[i, right], values[up, j], values[up, right]
    return entries, (x - j.astype(x.dtype), y - i.astype(y.dtype))
