"""The exact Euclidean distance of each cell from the nearest occupied cell."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core.types import JaxOrNumPy
from jaxslam.core.validation import (
    finite,
    or_none,
    positive,
    refusals_of,
    require,
)
from jaxslam.laser.grids._grid import Field, Grid, grid_map
from jaxslam.math._arrays import Number


def distance_field(grid: Grid, *, threshold: Number = 0.0, truncate: Number | None = None) -> Field:
    """The distance [m] from each cell's centre to that of the nearest occupied cell.

    Exact, in time linear in the number of cells (`squared_distances`). Without an occupied cell it
    is the diagonal of the map everywhere. Not differentiable by the log-odds: `interpolate` of it
    is differentiable by the point.

    Args:
        threshold: cells with log-odds above it are occupied.
        truncate: largest distance [m], None for no limit.
    Raises:
        ValueError: a grid that is none, a threshold that is not finite, or truncate not above 0.
    """
    with refusals_of("distance_field"):
        require("grid", grid, grid_map)
        require("threshold", threshold, finite())
        require("truncate", truncate, or_none(positive))
    largest = jnp.inf if truncate is None else truncate
    field: Field = _distance_field(grid, threshold, largest)
    return field


@functools.partial(jax.jit, inline=True)
def _distance_field(grid: Grid, threshold: Array, largest: Array) -> Field:
    squared = squared_distances(grid.log_odds > threshold)
    cells = jnp.sqrt(squared.astype(jnp.result_type(grid.log_odds, float)))
    return Field(
        jnp.minimum(grid.resolution * cells, largest),
        jnp.asarray(grid.origin),
        jnp.asarray(grid.resolution),
    )


def gradient(field: Field) -> Float[Array, "H W 2"]:
    """The slope of a field in the world's x and y by central differences, one-sided at borders.

    Units of the field per metre; zero along an axis of a single cell.
    """

    def slope(axis: int) -> Array:
        if field.values.shape[axis] < 2:
            return jnp.zeros_like(field.values)
        difference: PyTree = jnp.gradient(field.values, axis=axis)
        return jnp.asarray(difference / field.resolution)

    x, y = slope(1), slope(0)
    c, s = jnp.cos(field.origin[2]), jnp.sin(field.origin[2])
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)


def squared_distances(occupied: Bool[JaxOrNumPy, "H W"]) -> Int[Array, "H W"]:
    """The squared distance, in cells, of each cell from the nearest occupied cell: an integer.

    First d(i, j), to the nearest occupied cell in the same column. Then the minimum over k of
    (j - k)² + d(i, k)², the lower envelope of a parabola for each column k (Felzenszwalb &
    Huttenlocher 2012, "Distance transforms of sampled functions", Theory of Computing 8). Parabola
    q goes below parabola p at (h_q - h_p)/(2 (q - p)) with h_k = k² + d(i, k)²; the first cell from
    there on is computed in integers, exactly in float32 too. All rows are treated together, each
    with a separate stack; a step of the loop adds a parabola to a row or removes it, so that there
    are at most 2 W steps however unlike the rows are. H² + W² if no cell is occupied.
    """
    height, width = occupied.shape
    nothing = height**2 + width**2
    i = jnp.arange(height, dtype=jnp.int32)[:, None]
    # So far away that no such column is ever nearest, if another exists.
    far = height + width
    above = i - jax.lax.cummax(jnp.where(occupied, i, -far), axis=0)
    below = jax.lax.cummin(jnp.where(occupied, i, height + far), axis=0, reverse=True) - i
    column = jnp.minimum(jnp.minimum(above, below), far).T
    nearest = _envelope(column)
    k = jnp.arange(width, dtype=jnp.int32)[:, None]
    squared = (k - nearest) ** 2 + jnp.take_along_axis(column, nearest, axis=0) ** 2
    return jnp.where(occupied.any(), squared.T, nothing)


def near_distances(occupied: Bool[JaxOrNumPy, "H W"], reach: int) -> Int[Array, "H W"]:
    """The squared distances of `squared_distances`, in cells, but (reach + 1)² at most.

    The minimum over 2 reach + 1 shifts along each axis: for a few cells many times as fast as the
    exact transform, since it has no loop.
    """
    beyond = (reach + 1) ** 2
    # Small integers: more of them fit into a register of the processor.
    # Sums are at most (reach + 1)² + reach², below 2¹⁵ up to a reach of 127.
    squared = jnp.where(occupied, 0, beyond).astype(jnp.int16 if reach <= 100 else jnp.int32)
    for axis in (0, 1):
        size = squared.shape[axis]
        border = [(reach, reach) if axis == k else (0, 0) for k in (0, 1)]
        wide = jnp.pad(squared, border, constant_values=beyond)
        shifted = [
            jax.lax.slice_in_dim(wide, k, k + size, axis=axis)
            + jnp.asarray((k - reach) ** 2, squared.dtype)
            for k in range(2 * reach + 1)
        ]
        squared = functools.reduce(jnp.minimum, shifted)
    return jnp.minimum(squared, beyond)


@jax.custom_batching.custom_vmap
def _envelope(column: Int[Array, "W H"]) -> Int[Array, "W H"]:
    """The column whose parabola is lowest, at each place of each row (rows are columns here).

    | parabola q of a row | step |
    |---|---|
    | goes below the last one only where that has not yet begun | removes the last one |
    | otherwise | is added, and q grows |
    | q = W | the row waits for the others |
    """
    width, rows = column.shape
    row = jnp.arange(rows, dtype=jnp.int32)
    k = jnp.arange(width, dtype=jnp.int32)[:, None]
    h = (column**2 + k**2).reshape(-1)
    everywhere = -3  # below all results of `first_cell`, so that the first parabola stays

    def first_cell(rise: Array, run: Array) -> Array:
        """The cell ⌈rise/run⌉, by one division of floats, corrected; exact from 0 to width."""
        cell = jnp.ceil(rise.astype(jnp.float32) / run.astype(jnp.float32))
        cell = jnp.clip(cell, -1, width).astype(jnp.int32)
        beyond = cell * run - rise
        return cell + (beyond < 0).astype(jnp.int32) - (beyond >= run).astype(jnp.int32)

    def goes_on(state: tuple[Array, ...]) -> Array:
        return (state[0] < width).any()

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        q, top, parabola, begins, last, last_h, last_begins = state
        live = q < width
        new = jnp.minimum(q, width - 1)
        crossing = first_cell(h[new * rows + row] - last_h, jnp.where(live, 2 * (new - last), 2))
        remove = live & (crossing <= last_begins)
        add = live & ~remove
        top = top + add.astype(jnp.int32) - remove.astype(jnp.int32)
        at = top * rows + row
        last = jnp.where(add, new, parabola[at])
        last_begins = jnp.where(add, crossing, begins[at])
        parabola = parabola.at[at].set(last, unique_indices=True)
        begins = begins.at[at].set(last_begins, unique_indices=True)
        return (
            q + add.astype(jnp.int32),
            top,
            parabola,
            begins,
            last,
            h[last * rows + row],
            last_begins,
        )

    zeros = jnp.zeros(rows, jnp.int32)
    begins = jnp.full(width * rows, everywhere, jnp.int32)
    start: tuple[Array, ...] = (
        zeros + 1,
        zeros,
        jnp.zeros(width * rows, jnp.int32),
        begins,
        zeros,
        h[:rows],
        begins[:rows],
    )
    _, top, parabola, begins, *_ = jax.lax.while_loop(goes_on, step, start)
    # Parabolas are in the order of their columns, so the last to begin is the lowest.
    depth = jnp.arange(width, dtype=jnp.int32)[:, None]
    first = jnp.where(depth <= top[None, :], begins.reshape(width, rows), width)
    first = jnp.clip(first, 0, width)
    lowest = jnp.zeros((width + 1, rows), jnp.int32)
    lowest = lowest.at[first, row[None, :]].max(parabola.reshape(width, rows))
    return jax.lax.cummax(lowest, axis=0)[:width]


@_envelope.def_vmap
def _of_all(size: int, _: object, columns: Int[Array, "P W H"]) -> tuple[Array, bool]:
    """The rows of all tables of a batch together: a separate loop for each would copy all."""
    _, width, rows = columns.shape
    nearest = _envelope(jnp.swapaxes(columns, 0, 1).reshape(width, size * rows))
    return jnp.swapaxes(nearest.reshape(width, size, rows), 0, 1), True
