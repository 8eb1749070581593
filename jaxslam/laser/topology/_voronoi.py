"""The Voronoi skeleton of the free space of a grid, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.core.validation import InvalidField, positive, refusals_of, require
from jaxslam.laser.grids import Grid, distance_field
from jaxslam.laser.grids._grid import grid_map

_RIDGE = 0.6
"""Slope of the distance field below which a cell is on a ridge. A point whose nearest walls are in
directions 2β apart has slope cos β: 0 between parallel walls, 0.71 on the bisector of a right
angle, which is no ridge."""

_AROUND = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))
"""(row, column) steps to the eight neighbours, in order around."""


class Skeleton(NamedTuple):
    """The cells of free space that are as far from the walls as their surroundings allow."""

    cells: Bool[np.ndarray, "H W"]
    junctions: Bool[np.ndarray, "H W"]
    """cells of it where three branches or more meet"""
    clearance: Float[np.ndarray, "H W"]
    """distance [m] to the nearest cell that is not known to be free; 0 there"""


def skeleton(grid: Grid, *, clearance: float = 0.2) -> Skeleton:
    """The skeleton, a cell wide, of the cells where a robot of radius `clearance` [m] fits.

    Cells are removed in the order of their distance to the walls, as long as that changes neither
    connections nor holes (8-connected, by Yokoi's number), except ridges of the distance field:
    so rooms and corridors are reduced to the Voronoi line between their walls, without the
    branches into right-angled corners. A second round makes it one cell wide. Unknown cells count
    as walls. A loop in Python over the free cells: about 1 s for 10⁵.

    Raises ValueError on a grid that is none, a clearance that is not above 0, or no room for it.
    """
    with refusals_of("skeleton"):
        require("grid", grid, grid_map)
        require("clearance", clearance, positive)
    # A border of walls, so that each free cell has eight neighbours in the flat array.
    free = np.pad(np.asarray(grid.log_odds) < 0, 1)
    walls = Grid(np.where(free, -1.0, 1.0), grid.origin, grid.resolution)
    field = distance_field(walls)
    # From the centre of a cell to the border of the wall's: half a cell less than to its centre.
    half = 0.5 * float(np.asarray(grid.resolution))
    away = np.maximum(np.asarray(field.values, np.float64) - half, 0.0) * free
    fits = free & (away >= clearance)
    if not fits.any():
        raise InvalidField(
            "", f"no free cell is {clearance} m or more from what is not free", owner="skeleton"
        )
    slope = np.hypot(*np.gradient(np.asarray(field.values, np.float64) / (2 * half)))
    cells = fits.copy()
    _thin(cells, away, fits & (slope < _RIDGE), ends=False)
    _thin(cells, away, np.zeros_like(cells), ends=True)
    inner = slice(1, -1), slice(1, -1)
    around = np.stack([np.roll(cells, (-i, -j), (0, 1)) for i, j in _AROUND])
    # A branch begins where, in order around, a neighbour is absent and the next is present.
    branches = (~around & np.roll(around, -1, axis=0)).sum(axis=0)
    return Skeleton(cells[inner], (cells & (branches >= 3))[inner], away[inner])


def _thin(
    cells: Bool[np.ndarray, "H W"],
    away: Float[np.ndarray, "H W"],
    kept: Bool[np.ndarray, "H W"],
    ends: bool,
) -> None:
    """Remove cells in place, the nearest to a wall first, where the topology stays.

    kept: never removed; with `ends`, neither are cells with one neighbour or none.
    """
    width = cells.shape[1]
    flat, table = cells.reshape(-1), _removal_table(ends)
    steps = [i * width + j for i, j in _AROUND]
    candidates = np.flatnonzero(cells & ~kept)
    candidates = candidates[np.argsort(away.reshape(-1)[candidates], kind="stable")]
    # Python's integers and bytes: reading NumPy arrays entry by entry is slow.
    left = candidates.tolist()
    present = bytearray(flat.astype(np.uint8).tobytes())
    while True:
        remaining = []
        for at in left:
            code = 0
            for k, step in enumerate(steps):
                code |= present[at + step] << k
            if table[code]:
                present[at] = 0
            else:
                remaining.append(at)
        if len(remaining) == len(left):
            break
        left = remaining
    flat[:] = np.frombuffer(bytes(present), np.uint8) > 0


def _removal_table(ends: bool) -> list[bool]:
    """Whether a cell can go without a change of topology, by the code of its eight neighbours.

    Bit k of the code is neighbour k of `_AROUND`. It can if Yokoi's number for 8-connected cells is
    1: Σ over the four edges of x̄_k - x̄_k x̄_k+1 x̄_k+2 with x̄ = 1 - x.
    """
    out = []
    for code in range(256):
        x = [1 - (code >> k & 1) for k in range(8)]
        number = sum(x[k] - x[k] * x[(k + 1) % 8] * x[(k + 2) % 8] for k in (0, 2, 4, 6))
        out.append(number == 1 and not (ends and sum(x) >= 7))
    return out
