"""The data of a grid map and of a field over one: coordinates, interpolation."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxslam.core._numbers import is_concrete
from jaxslam.core._reprs import short_repr
from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import (
    InvalidField,
    array_of,
    finite,
    instance_of,
    positive,
    refusals_of,
    require,
)
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
    origin = jnp.asarray(grid.origin)
    dtype = jnp.result_type(origin, grid.resolution, float)
    rows, columns = (jnp.arange(size, dtype=dtype) + 0.5 for size in (height, width))
    y, x = jnp.meshgrid(rows, columns, indexing="ij")
    local = grid.resolution * jnp.stack([x, y], axis=-1)
    return jnp.einsum("ab,hwb->hwa", se2.rotation(origin[2]), local) + origin[None, None, :2]


def grid_map(value: Any) -> Grid:
    """The check of a grid; within a trace only shapes are checked.

    Refused are log-odds other than a finite array of floats of at least one cell, an origin that is
    no pose, and a resolution that is not above 0.
    """
    grid: Grid = instance_of(Grid)(value)
    require("log_odds", grid.log_odds, array_of("H", "W", kind=np.floating))
    if 0 in (shape := np.shape(grid.log_odds)):
        raise InvalidField("log_odds", f"expected at least one cell, got shape {shape}")
    require("origin", grid.origin, finite(3))
    require("resolution", grid.resolution, positive)
    if is_concrete(grid.log_odds) and not np.all(np.isfinite(grid.log_odds)):
        raise InvalidField("log_odds", "expected finite numbers; unknown is 0")
    return grid


def interpolate(field: Field, points: ArrayLike) -> Float[Array, "*n"]:
    """The values of a field at points (..., 2) of the world [m], bilinear between centres of cells.

    Off the map, and within half a cell of its border, the value is that of the nearest point of the
    rectangle of centres: continuous everywhere, and the gradient by a point is finite everywhere;
    across the border it is zero. At a line between four centres the gradient is of one side.

    Raises ValueError on other types than fields, and on points of a shape other than (..., 2).
    """
    with refusals_of("interpolate"):
        require("field", field, instance_of(Field))
        points = jnp.asarray(points)
        if points.ndim == 0 or points.shape[-1] != 2:
            raise InvalidField("points", f"expected (x, y), got shape {points.shape}")
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
