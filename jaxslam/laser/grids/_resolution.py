"""Maps of another resolution, parts of maps, and how alike two maps are."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core.validation import InvalidField, positive, refusals_of, require
from jaxslam.laser.grids._grid import Field, Grid, centers, grid_map, interpolate
from jaxslam.math import se2


def resample(grid: Grid, resolution: float) -> Grid:
    """The map in cells of another size [m], with the same origin.

    A new cell has the mean log-odds of the covered cells, weighted by area, with 0 (unknown) beyond
    the map. So a cell over unknown cells alone is unknown, and the integral of the log-odds over
    the map is unchanged. A wall thinner than a new cell fades: the mean is not the maximum.

    Raises ValueError on a grid that is none, a resolution that is not above 0, or one within a
    trace, since it sets the shape.
    """
    with refusals_of("resample"):
        require("grid", grid, grid_map)
        require("resolution", resolution, positive)
        if not is_concrete(resolution, grid.resolution):
            raise InvalidField("resolution", "it sets the shape: expected one outside the trace")
    factor = float(resolution) / float(grid.resolution)
    log_odds = jnp.asarray(grid.log_odds)
    up, across = (jnp.asarray(_overlaps(n, factor), log_odds.dtype) for n in log_odds.shape)
    log_odds = up @ log_odds @ across.T
    return Grid(log_odds, grid.origin, jnp.asarray(resolution, log_odds.dtype))


def _overlaps(size: int, factor: float) -> Float[np.ndarray, "new old"]:
    """The share of each new cell, `factor` old cells long, that each old cell covers."""
    # 1e-9: a size that is a multiple of the new cells must not get another by rounding.
    count = int(np.ceil(size / factor - 1e-9))
    begins = factor * np.arange(count)[:, None]
    old = np.arange(size)[None, :]
    shared = np.minimum(begins + factor, old + 1) - np.maximum(begins, old)
    return np.asarray(np.maximum(shared, 0.0) / factor)


def crop(grid: Grid, low: ArrayLike, high: ArrayLike) -> Grid:
    """The part of the map between two corners (x, y) [m] of a box in the frame of the grid.

    The box grows to whole cells and ends at the border of the map.

    Raises ValueError on a grid that is none, corners within a trace, and a box off the map.
    """
    with refusals_of("crop"):
        require("grid", grid, grid_map)
        if not is_concrete(low, high, grid.resolution):
            raise InvalidField("", "the box sets the shape: expected corners outside the trace")
        corners = np.stack([np.asarray(low, float), np.asarray(high, float)])
        if corners.shape != (2, 2) or not np.all(np.isfinite(corners)):
            raise InvalidField("", f"expected two corners (x, y), got {low!r} and {high!r}")
    cells = corners / float(grid.resolution)
    height, width = np.shape(grid.log_odds)
    # 1e-9: a corner on a border between cells takes no further cell by rounding.
    first = np.maximum(np.floor(cells[0] + 1e-9), 0).astype(int)
    last = np.minimum(np.ceil(cells[1] - 1e-9), (width, height)).astype(int)
    if np.any(first >= last):
        raise InvalidField(
            "",
            f"the box from {corners[0]} to {corners[1]} has no cell of the map, which has "
            f"{width} × {height} of {grid.resolution} m",
            owner="crop",
        )
    origin = jnp.asarray(grid.origin)
    to_corner = [*(first * float(grid.resolution)), 0.0]
    shift = jnp.asarray(to_corner, jnp.result_type(origin, float))
    log_odds = grid.log_odds[first[1] : last[1], first[0] : last[0]]
    return Grid(log_odds, se2.compose(origin, shift), grid.resolution)


def correlation(a: Grid, b: Grid) -> Float[Array, ""]:
    """The correlation, in [-1, 1], of the occupancy of two maps where both are known.

    r = Σ w (m_a - m̄_a)(m_b - m̄_b) / sqrt(Σ w (m_a - m̄_a)² Σ w (m_b - m̄_b)²), with m the
    probability of a cell. Map b, which may have another origin and resolution, is interpolated at
    the centres of the cells of a; w is 1 where a is known, times the share of b that is known
    there. Differentiable by the origins, so that a map can be matched to another. 0 where one of
    them is constant or they have no known cell in common.

    Thrun, Burgard & Fox 2005, "Probabilistic robotics", section 6.5, with a mean of each map.
    """
    with refusals_of("correlation"):
        require("a", a, grid_map)
        require("b", b, grid_map)
    points = centers(a)
    bordered = Grid(jnp.pad(b.log_odds, 1), b.origin, b.resolution)  # unknown off the map
    corner = jnp.asarray([-1.0, -1.0, 0.0], jnp.result_type(b.resolution, float)) * b.resolution
    frame = se2.compose(jnp.asarray(b.origin), corner), jnp.asarray(b.resolution)
    share = interpolate(Field(jnp.asarray(bordered.observed, points.dtype), *frame), points)
    weight = jnp.where(a.observed, share, 0.0)
    probability_b = interpolate(Field(bordered.probability, *frame), points)
    total = weight.sum()
    total = jnp.where(total > 0, total, 1.0)

    def center(values: Array) -> Array:
        return values - (weight * values).sum() / total

    off_a, off_b = center(a.probability), center(probability_b)
    product = (weight * off_a * off_a).sum() * (weight * off_b * off_b).sum()
    varies = product > 1e-12 * total**2  # probabilities that vary by a thousandth; rounding: 1e-28
    r = (weight * off_a * off_b).sum() / jnp.sqrt(jnp.where(varies, product, 1.0))
    return jnp.where(varies, jnp.clip(r, -1.0, 1.0), 0.0)
