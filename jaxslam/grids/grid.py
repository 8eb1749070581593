"""The data of an occupancy grid, and its coordinates.

Cell (i, j), row i and column j, is the square [j, j+1] × [i, i+1] times the resolution in the frame
of the grid, whose pose in the world is `origin`: row 0 is at the bottom. Continuous coordinates
(x, y) in cells, as `to_cells` has them, are (0.5, 0.5) at the centre of cell (0, 0).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxslam.core.numbers import check_real, is_concrete, shape_told
from jaxslam.math import se2
from jaxslam.types import JaxOrNumPy


class Grid(NamedTuple):
    """An occupancy grid: log-odds of H × W cells, the pose of its lower left corner, cell size.

    A log-odds of exactly 0 is *unknown*: no evidence for occupied or free. What sums evidence keeps
    it exactly 0 where nothing was measured. Evidence that cancels exactly is unknown as well, since
    it says nothing of the cell; who must tell the two apart keeps counts (`grids.Counts`).
    """

    log_odds: Float[JaxOrNumPy, "H W"]
    """log p/(1 - p), p the probability that a cell is occupied; finite"""
    origin: Float[JaxOrNumPy, "3"]
    """pose of the lower left corner of cell (0, 0) in the world"""
    resolution: Float[JaxOrNumPy, ""]
    """side of a cell [m]"""

    @property
    def probability(self) -> Float[Array, "H W"]:
        """The probability p = 1/(1 + exp(-log-odds)) that a cell is occupied; ½ if unknown."""
        return jax.nn.sigmoid(self.log_odds)

    @property
    def known(self) -> Bool[JaxOrNumPy, "H W"]:
        """Whether there is evidence for a cell: its log-odds are not 0."""
        return self.log_odds != 0


class Field(NamedTuple):
    """Numbers at the centres of the cells of a grid, as a distance field has them."""

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

    Refused are log-odds that are no finite array of floats of at least one cell, an origin that is
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
            f"got {shape_told(grid.log_odds)}"
        )
    check_frame(name, grid.origin, grid.resolution)
    if is_concrete(grid.log_odds) and not np.all(np.isfinite(grid.log_odds)):
        raise ValueError(f"{name}: expected finite log-odds; unknown is 0")


def check_frame(name: str, origin: ArrayLike, resolution: ArrayLike) -> None:
    """Raise ValueError unless origin is a pose, and resolution a finite number above 0."""
    check_real(name, origin=origin, resolution=resolution)
    if np.shape(origin) != (3,):
        raise ValueError(
            f"{name}: expected an origin that is a pose (x, y, θ), got {shape_told(origin)}"
        )
    if np.shape(resolution) != ():
        raise ValueError(f"{name}: expected one resolution, got {shape_told(resolution)}")
    if not is_concrete(origin, resolution):
        return
    if not np.all(np.isfinite(origin)):
        raise ValueError(f"{name}: expected a finite origin, got {np.asarray(origin)}")
    if not 0 < float(np.asarray(resolution)) < np.inf:
        raise ValueError(f"{name}: expected a resolution above 0, got {resolution}")
