"""Ranges to the nearest obstacle of a grid along rays."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree, UInt8
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core._reprs import describe, shape_text
from jaxslam.core.validation import (
    InvalidField,
    one_of,
    or_none,
    positive,
    real,
    refusals_of,
    require,
)
from jaxslam.laser.grids._distance import squared_distances
from jaxslam.laser.grids._grid import Grid, grid_map, interpolate_cells, to_cells
from jaxslam.laser.grids._traversal import MOST, OFF, STOP, march
from jaxslam.math._xla import hot_jit

_GRAZING = 0.05
"""Least |cos| of the angle between a ray and the normal of a wall in a derivative (chosen: 87°), so
that a beam along a wall has no huge derivative."""

METHODS = ("surface", "cells")


class RayMap(NamedTuple):
    """A grid prepared for many rays by `ray_map`; `cast` takes it in place of the grid."""

    solid: Float[Array, "H W"]
    """solid share of a cell less ½: p - ½, and -½ where unknown"""
    ahead: UInt8[Array, "H2 W2"]
    """how far a ray may go from anywhere in a square [quarters of a square], `STOP` where it may
    end, `OFF` in a border off the map; squares are cells, or lie between four centres of cells"""
    origin: Float[Array, "3"]
    resolution: Float[Array, ""]


def ray_map(grid: Grid, *, method: str | None = None, skip: bool = True) -> RayMap:
    """A grid prepared for `cast` by one of two methods, which only `cast` distinguishes.

    Args:
        method: "surface" or "cells", see `cast`. None chooses by the map: "surface" where each cell
            is known and there are more than three log-odds, as `simulation.walls.rasterize` makes
            graded maps; else "cells": for trinary maps, as `read_map` reads most files, for maps
            made from scans, and within a trace, where the values are not known.
        skip: compute the distance field, with which rays cross free space in long steps (sphere
            tracing). The ranges are the same to rounding, but for rays through an exact corner.
    Raises:
        ValueError: a grid that is none, or without a free cell; an unknown method.
    """
    with refusals_of("ray_map"):
        require("grid", grid, grid_map)
        require("method", method, or_none(one_of(*METHODS)))
        if is_concrete(grid.log_odds) and not np.any(np.asarray(grid.log_odds) < 0):
            raise InvalidField("grid", "it has no free cell (log-odds below 0)")
    if method is None:
        method = "cells"
        # p may be the share of a cell that is solid with more than three log-odds, so at least two
        # between the ends, all of them known: in a map made from scans p is the certainty of a
        # cell, and "surface" goes too far. Found without sorting millions of cells.
        if is_concrete(grid.log_odds) and not np.any(np.asarray(grid.log_odds) == 0):
            log_odds = np.asarray(grid.log_odds)
            between = log_odds[(log_odds > log_odds.min()) & (log_odds < log_odds.max())]
            if between.size and between.min() < between.max():
                method = "surface"
    rays: RayMap = _ray_map(grid, method, skip)
    return rays


@partial(jax.jit, static_argnames=("method", "skip"), inline=True)
def _ray_map(grid: Grid, method: str, skip: bool) -> RayMap:
    solid = jnp.where(grid.observed, grid.probability, 0.0) - 0.5
    if method == "cells":
        stops = solid > 0
    else:
        # The squares between four centres of cells in which a surface may be, (H+1, W+1). The cells
        # at the border are repeated, so that the squares cover the map.
        edged = jnp.pad(solid, 1, mode="edge")
        across = jnp.maximum(edged[:, 1:], edged[:, :-1])
        stops = jnp.maximum(across[1:], across[:-1]) > 0
    ahead = jnp.zeros(stops.shape, jnp.uint8)
    if skip:
        # Beyond the border all counts as occupied: no step leads off the map. The distance between
        # two squares is at least that from the centre of the first to the squares around the
        # second, hence the dilation.
        bordered = jnp.pad(jnp.pad(stops, 1, constant_values=True), 1)
        rows = bordered[2:] | bordered[1:-1] | bordered[:-2]
        around = rows[:, 2:] | rows[:, 1:-1] | rows[:, :-2]
        away = jnp.sqrt(squared_distances(around))[1:-1, 1:-1]
        ahead = jnp.minimum(jnp.floor(4.0 * away), MOST).astype(jnp.uint8)
    ahead = jnp.pad(jnp.where(stops, jnp.uint8(STOP), ahead), 1, constant_values=OFF)
    return RayMap(solid, ahead, jnp.asarray(grid.origin), jnp.asarray(grid.resolution, solid.dtype))


def cast(
    grid: Grid | RayMap,
    pose: ArrayLike,
    angles: ArrayLike,
    max_range: ArrayLike,
) -> Float[Array, "*poses B"]:
    """The range [m] of each beam from each pose: to the nearest obstacle, at most max_range.

    A beam leaves the pose (x, y, θ) in direction θ + angle. Unknown cells do not stop it. A beam
    that leaves the map has max_range, and within a trace one that starts off it; one that starts in
    an obstacle has 0.

    Two methods, by `ray_map`, and both are differentiable; a plain grid is cast by the one that
    `ray_map` takes by default:

    "cells": the beam ends where it enters an occupied cell. Every cell that it crosses is visited
        in order (Amanatides & Woo 1987, "A fast voxel traversal algorithm for ray tracing"). A wall
        inside a cell is up to a cell's diagonal farther than the cell; a beam along a wall ends
        even earlier, at the first of the cells that it grazes.
    "surface": the beam ends on the line where p, interpolated between centres of cells, is ½. It is
        found exactly: along a ray, p is a parabola in each square of four centres. Where p is the
        share of a cell that is solid (`simulation.walls.rasterize` makes such grids), this line is
        the wall to a fraction of a cell: the range of a beam less than 63° from the normal, and one
        and a half cells from edges and corners, is wrong by less than half a cell, in the median by
        less than a tenth (`python -m benchmarks --only grids`). These are rounded: beside an edge a
        beam may hit or miss wrongly. If p is not a share, it goes too far. In a trinary map the
        corners of cells are cut, by half a cell from a pillar or an end of a wall, and beams behind
        them go on to the next wall. In a map of log-odds it passes walls that are weakly occupied
        beside cells that are surely free: between two such cells that touch by a corner p is below
        ½ (`python -m benchmarks --only grids` has the share of beams that pass walls of a real
        map).

    The derivative by the pose is that of the range to a straight wall through the hit,
    dr = -n·(dt + r dφ e⊥)/(n·e), with e the direction, φ its angle, dt the shift of the origin, and
    n the normal of the wall: the slope of p around the hit, over two cells. So it is not the
    derivative of a staircase of cells, and only near that of the range as computed. It is 0 where
    nothing is hit. |n·e|/|n| below `_GRAZING`, of a beam along the wall, counts as that. That a
    beam passes an edge or hits it is a jump, which no derivative knows.

    Args:
        grid: a `Grid`, or its `RayMap`, which is faster for many rays.
        pose: (3,) or with leading axes.
        angles: (B,) of beams in the frame of the pose [rad].
        max_range: [m].
    Raises:
        ValueError: a grid that is none, shapes, numbers that are not finite, max_range not above 0;
            outside a trace, a pose off the map.
    """
    with refusals_of("cast"):
        if not isinstance(grid, Grid | RayMap):
            raise InvalidField("grid", f"expected a Grid or a RayMap, got {describe(grid)}")
        require("pose", pose, real)
        require("angles", angles, real)
        require("max_range", max_range, positive)
        pose, angles = jnp.asarray(pose), jnp.asarray(angles)
        if pose.ndim < 1 or pose.shape[-1] != 3:
            raise InvalidField("pose", f"expected poses (x, y, θ), got shape {shape_text(pose)}")
        if angles.ndim != 1 or angles.size == 0:
            raise InvalidField("angles", f"expected shape (at least 1,), got {shape_text(angles)}")
        if is_concrete(angles) and not np.all(np.isfinite(angles)):
            raise InvalidField("angles", "expected finite numbers")
        if isinstance(grid, Grid):
            grid = ray_map(grid, skip=False)
        if is_concrete(grid, pose):
            flat = np.asarray(pose).reshape(-1, 3)
            c, s = np.cos(grid.origin[2]), np.sin(grid.origin[2])
            local = (flat[:, :2] - np.asarray(grid.origin)[:2]) @ np.array([[c, -s], [s, c]])
            height, width = grid.solid.shape
            size = float(grid.resolution) * np.array([width, height])
            inside = np.all((local >= 0) & (local <= size), axis=1) & np.isfinite(flat[:, 2])
            if not inside.all():
                k = int(np.argmin(inside))
                off = (
                    f"pose {k}, {flat[k].tolist()}, is off the map of {size[0]:g} m × {size[1]:g} m"
                )
                raise InvalidField("pose", off)
    return _cast(grid, pose, angles, max_range)


@hot_jit
def _cast(
    grid: RayMap, pose: Float[Array, "*poses 3"], angles: Float[Array, "B"], max_range: Array
) -> Float[Array, "*poses B"]:
    shape = (*pose.shape[:-1], len(angles))
    dtype = jnp.result_type(pose, angles, grid.solid, 0.0)
    pose, angles = pose.reshape(-1, 3).astype(dtype), angles.astype(dtype)
    grid = jax.tree.map(lambda part: part.astype(dtype), grid)._replace(ahead=grid.ahead)
    heading = (pose[:, 2] - grid.origin[2])[:, None] + angles[None, :]
    direction = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)
    start = to_cells(grid.origin, grid.resolution, pose[:, :2])
    starts = jnp.broadcast_to(start[:, None, :], direction.shape)
    limit = jnp.asarray(max_range, dtype) / grid.resolution
    length, _ = _lengths(grid, starts.reshape(-1, 2), direction.reshape(-1, 2), limit)
    return (grid.resolution * jnp.minimum(length, limit)).reshape(shape)


@jax.custom_jvp
def _lengths(
    grid: RayMap, start: Float[Array, "R 2"], direction: Float[Array, "R 2"], limit: Array
) -> tuple[Float[Array, "R"], Bool[Array, "R"]]:
    """The lengths [cells] of rays from start (x, y) [cells], and whether something is hit."""
    if grid.ahead.shape[0] == grid.solid.shape[0] + 2:  # its squares are cells
        length_and_hit: tuple[Array, Array] = march(grid.ahead, None, start, direction, limit)
    else:
        corners = jnp.pad(grid.solid, 1, mode="edge")
        length_and_hit = march(grid.ahead, corners, start + 0.5, direction, limit)
    return length_and_hit


@_lengths.defjvp
def _derivative(primals: PyTree, tangents: PyTree) -> PyTree:
    """The derivative of the range, -n·(dt + r de)/(n·e), of rays that hit something.

    The length is that of `_lengths` again, so that a second derivative meets this rule and not the
    loop of `march`.
    """
    grid, start, direction, _ = primals
    length, hit = _lengths(*primals)
    normal = _slope(grid.solid, start + length[:, None] * direction)
    steep = (normal * direction).sum(axis=-1)
    least = _GRAZING * jnp.sqrt((normal * normal).sum(axis=-1))
    steep = jnp.where(steep < 0, jnp.minimum(steep, -least), jnp.maximum(steep, least))
    sure = hit & (steep != 0)
    rate = jnp.where(sure, 1.0 / jnp.where(sure, steep, 1.0), 0.0)
    moved = tangents[1] + length[:, None] * tangents[2]
    along = jnp.where(hit, -rate * (normal * moved).sum(axis=-1), tangents[3])
    return (length, hit), (along, np.zeros(hit.shape, jax.dtypes.float0))


_AROUND = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
"""Offsets (x, y) of nine cells."""
_WEIGHTS = _AROUND * np.array([2.0 if 0 in place else 1.0 for place in _AROUND])[:, None] / 8
"""Sobel's weights of the slopes in x and y: (-1, 0, 1)/2 along an axis, (1, 2, 1)/4 across."""


def _slope(solid: Float[Array, "H W"], at: Float[Array, "R 2"]) -> Float[Array, "R 2"]:
    """The slope of p around points [cells], over two cells: Sobel's weights of nine values.

    The bilinear slope at the point itself changes from cell to cell along a slanted wall.
    """
    places = at[:, None, :] - 0.5 + jnp.asarray(_AROUND, at.dtype)[None]
    return jnp.einsum(
        "rk,ka->ra", interpolate_cells(solid, places), jnp.asarray(_WEIGHTS, at.dtype)
    )
