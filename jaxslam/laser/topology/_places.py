"""Places and doors of a grid, and places of a path.

Places of a grid are parts of the skeleton of free space, divided at narrowings; places of a path or
a pose graph are groups of poses, adjacent where the robot went between them.
"""

from typing import NamedTuple

import jax
import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.core.validation import InvalidField, positive, refusals_of, require
from jaxslam.laser.grids import Grid, centers
from jaxslam.laser.topology._voronoi import Skeleton, skeleton

_centers = jax.jit(centers, inline=True)

_HALF = ((0, 1), (1, -1), (1, 0), (1, 1))
"""(row, column) steps to half of the neighbours; each pair of cells once"""


class Door(NamedTuple):
    """A narrowing between two places."""

    position: Float[np.ndarray, "2"]
    """[m]"""
    width: float
    """[m], to about a cell"""
    places: tuple[int, int]
    """the two places, in ascending order"""
    cell: tuple[int, int]
    """row and column"""


class TopologicalMap(NamedTuple):
    """Places and the doors between them, over a grid."""

    label: Int[np.ndarray, "H W"]
    """place of each free cell that a place reaches, -1 elsewhere"""
    center: Float[np.ndarray, "P 2"]
    """cell of the skeleton of a place that is nearest to their mean [m]"""
    area: Float[np.ndarray, "P"]
    """[m²]"""
    doors: tuple[Door, ...]
    skeleton: Skeleton
    grid: Grid

    @property
    def adjacent(self) -> Bool[np.ndarray, "P P"]:
        """Mask of the pairs of places with a door between them."""
        out = np.zeros((len(self.center),) * 2, bool)
        for door in self.doors:
            out[door.places] = out[door.places[::-1]] = True
        return out


def topological_map(
    grid: Grid, *, clearance: float = 0.2, max_width: float = 1.3, prominence: float = 0.15
) -> TopologicalMap:
    """The places of a map and the doors between them.

    Cells of the `skeleton` are joined in the order of their width, the widest first:

    | parts beside the cell | the cell |
    |---|---|
    | none | begins a part |
    | two or more that are wider by `prominence`, and it is at most max_width wide | is a door |
    | otherwise | joins the parts |

    The parts in the end are the places. A free cell belongs to the place whose skeleton is nearest
    on a way through free cells.

    Args:
        clearance: radius of the robot [m]; narrower passages do not connect.
        max_width: [m] widest narrowing that counts as a door.
        prominence: [m] by how much half of a door's width is less than that of either side.
    Raises:
        ValueError: as `skeleton`, and on numbers that are not above 0.
    """
    with refusals_of("topological_map"):
        require("max_width", max_width, positive)
        require("prominence", prominence, positive)
    ridge = skeleton(grid, clearance=clearance)
    height, width = ridge.cells.shape
    away = ridge.clearance.reshape(-1)
    cells = np.flatnonzero(ridge.cells)
    order = cells[np.argsort(-away[cells], kind="stable")]
    # Parts as trees of cells: the root of a part is its widest cell.
    parent: dict[int, int] = {}
    gates: list[tuple[int, int, int]] = []

    def root(cell: int) -> int:
        while parent[cell] != cell:
            # Path halving: later searches from here are shorter.
            parent[cell] = parent[parent[cell]]
            cell = parent[cell]
        return cell

    for at in order.tolist():
        i, j = divmod(at, width)
        near = [
            (i + a) * width + j + b
            for a in (-1, 0, 1)
            for b in (-1, 0, 1)
            if 0 <= i + a < height and 0 <= j + b < width
        ]
        parts = sorted({root(c) for c in near if c in parent}, key=lambda c: (-away[c], c))
        high = [c for c in parts if away[c] >= away[at] + prominence]
        if len(high) > 1 and 2 * away[at] <= max_width:
            gates.append((at, high[0], high[1]))
            for low in set(parts) - set(high):  # no places of their own: recesses of the door
                parent[low] = high[0]
            continue
        parent[at] = at
        for part in parts:
            parent[root(at)] = part if away[part] >= away[root(at)] else root(at)
            parent[part] = root(at)
    return _label(grid, ridge, {c: root(c) for c in parent}, gates)


def _label(
    grid: Grid, ridge: Skeleton, part: dict[int, int], gates: list[tuple[int, int, int]]
) -> TopologicalMap:
    """The map by the part of each cell of the skeleton.

    Args:
        part: root of each cell.
        gates: doors: a cell, and the roots of the parts on both sides.
    """
    shape = ridge.cells.shape
    center = cell_centers(grid)
    away = ridge.clearance.reshape(-1)
    roots = sorted(set(part.values()))
    index = {root: k for k, root in enumerate(roots)}
    starts = np.array(list(part), int)
    place_of_start = np.array([index[root] for root in part.values()], int)
    weights = neighbours((away > 0).reshape(shape))
    size = float(np.asarray(grid.resolution))
    # `min_only`: a single search from all cells of the skeleton, and the nearest of each cell.
    _, _, source = scipy.sparse.csgraph.dijkstra(
        weights, directed=False, indices=starts, min_only=True, return_predecessors=True
    )
    place = np.full(len(away), -1)
    place[starts] = place_of_start
    reached = source >= 0
    place[reached] = place[source[reached]]
    doors = []
    for at, *sides in gates:
        low, high = sorted(index[part[side]] for side in sides)
        if low != high:  # the parts were joined elsewhere
            doors.append(Door(center[at], 2 * float(away[at]), (low, high), divmod(at, shape[1])))
    middles = []
    for k in range(len(roots)):
        points = center[starts[place_of_start == k]]
        middles.append(points[((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin()])
    return TopologicalMap(
        label=place.reshape(shape),
        center=np.array(middles),
        area=np.bincount(place[place >= 0], minlength=len(roots)) * size**2,
        doors=tuple(doors),
        skeleton=ridge,
        grid=grid,
    )


def cell_centers(grid: Grid) -> Float[np.ndarray, "n 2"]:
    """The centres of all cells in the world [m], row by row."""
    return np.asarray(_centers(grid), np.float64).reshape(-1, 2)


def neighbours(cells: Bool[np.ndarray, "H W"]) -> "scipy.sparse.csr_matrix":
    """The graph of cells and their eight neighbours among them, weighted by distance in cells."""
    height, width = cells.shape
    index = np.arange(height * width).reshape(height, width)
    rows, columns, weights = [], [], []
    for i, j in _HALF:
        # Two views of one shape, (i, j) apart; j may be negative.
        cell = index[: height - i, max(0, -j) : width - max(0, j)]
        shifted = index[i:, max(0, j) : width - max(0, -j)]
        both = cells.reshape(-1)[cell] & cells.reshape(-1)[shifted]
        rows.append(cell[both])
        columns.append(shifted[both])
        weights.append(np.full(int(both.sum()), np.hypot(i, j)))
    pairs = np.concatenate(rows), np.concatenate(columns)
    return scipy.sparse.csr_matrix((np.concatenate(weights), pairs), shape=(height * width,) * 2)


class PathPlaces(NamedTuple):
    """Places that cover the poses of a path."""

    center: Int[np.ndarray, "P"]
    """pose that represents a place"""
    place: Int[np.ndarray, "N"]
    """place of each pose, by the nearest center"""
    adjacent: Bool[np.ndarray, "P P"]


def path_places(poses: ArrayLike, pairs: ArrayLike, *, radius: float) -> PathPlaces:
    """The places of a pose graph: no pose is further than `radius` [m] from its place's center.

    In the order of the poses, a pose that is further from all centers so far becomes a center. Two
    places are adjacent if an edge of the graph joins them.

    Args:
        poses: (N, 2 or 3). pairs: (E, 2) of poses that an edge connects, loops included; for a path
            without a graph the pairs (k, k + 1).
    Raises:
        ValueError: on no pose, a radius that is not above 0, or pairs of poses that are none.
    """
    points = np.asarray(poses, np.float64)
    edges = np.asarray(pairs, int).reshape(-1, 2)
    with refusals_of("path_places"):
        require("radius", radius, positive)
        if points.ndim != 2 or len(points) == 0:
            raise InvalidField("poses", f"expected at least one, got shape {points.shape}")
        if not np.isfinite(points).all():
            raise InvalidField("poses", "expected finite numbers")
        if len(edges) and not (edges.min() >= 0 and edges.max() < len(points)):
            raise InvalidField("pairs", f"expected those of {len(points)} poses, got {edges.max()}")
    centers: list[int] = []
    for k, point in enumerate(points[:, :2]):
        if not centers or np.linalg.norm(points[centers, :2] - point, axis=1).min() > radius:
            centers.append(k)
    gap = np.linalg.norm(points[:, None, :2] - points[None, centers, :2], axis=2)
    place = gap.argmin(axis=1)
    adjacent = np.zeros((len(centers),) * 2, bool)
    first, second = place[edges].T
    adjacent[first, second] = adjacent[second, first] = True
    np.fill_diagonal(adjacent, False)
    return PathPlaces(np.array(centers), place, adjacent)
