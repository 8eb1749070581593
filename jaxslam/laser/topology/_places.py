"""Places and doors of a grid, and places of a path.

Of a grid, parts of the skeleton of free space, divided at narrowings; of a path or a pose graph,
poses in groups, adjacent where the robot went between them.
"""

from typing import NamedTuple

import jax
import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

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
    cell: tuple[int, int]
    """row and column"""


class TopologicalMap(NamedTuple):
    """Places and the doors between them, over a grid."""

    label: Int[np.ndarray, "H W"]
    """place of each free cell that a place reaches, -1 elsewhere"""
    center: Float[np.ndarray, "P 2"]
    """of each place: the cell of its skeleton nearest to the mean of them [m]"""
    area: Float[np.ndarray, "P"]
    """[m²]"""
    doors: tuple[Door, ...]
    skeleton: Skeleton
    grid: Grid

    @property
    def adjacent(self) -> Bool[np.ndarray, "P P"]:
        """Whether a door leads from one place to another."""
        out = np.zeros((len(self.center),) * 2, bool)
        for door in self.doors:
            out[door.places] = out[door.places[::-1]] = True
        return out


def topological_map(
    grid: Grid, *, clearance: float = 0.2, max_width: float = 1.3, prominence: float = 0.15
) -> TopologicalMap:
    """The places of a map and the doors between them.

    Cells of the `skeleton` are joined from the widest down. One that joins two parts is a door, and
    stays apart, if it is narrower than max_width and each part has somewhere a clearance that is
    `prominence` more; otherwise the parts are one. What is left are the places. A free cell belongs
    to the place whose skeleton is nearest on a way through free cells.

    Args:
        clearance: radius of the robot [m]; narrower passages do not connect.
        max_width: [m] widest narrowing that counts as a door.
        prominence: [m] by how much half of a door's width is less than that of either side.
    Raises:
        ValueError: as `skeleton`, and on numbers that are not above 0.
    """
    if not (max_width > 0 and prominence > 0):
        raise ValueError(
            f"topological_map: expected numbers above 0, got {max_width} and {prominence}"
        )
    found = skeleton(grid, clearance=clearance)
    height, width = found.cells.shape
    away = found.clearance.reshape(-1)
    cells = np.flatnonzero(found.cells)
    order = cells[np.argsort(-away[cells], kind="stable")]
    parent: dict[int, int] = {}
    gates: list[tuple[int, int, int]] = []

    def root(cell: int) -> int:
        while parent[cell] != cell:
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
        # Parts around, the widest first: the root of a part is its widest cell.
        parts = sorted({root(c) for c in near if c in parent}, key=lambda c: (-away[c], c))
        high = [c for c in parts if away[c] >= away[at] + prominence]
        if len(high) > 1 and 2 * away[at] <= max_width:
            gates.append((at, high[0], high[1]))
            for low in set(parts) - set(high):
                parent[low] = high[0]
            continue
        parent[at] = at
        for part in parts:
            parent[root(at)] = part if away[part] >= away[root(at)] else root(at)
            parent[part] = root(at)
    return _label(grid, found, {c: root(c) for c in parent}, gates)


def _label(
    grid: Grid, found: Skeleton, part: dict[int, int], gates: list[tuple[int, int, int]]
) -> TopologicalMap:
    """The map from the part of each cell of the skeleton, named by one of its cells."""
    shape = found.cells.shape
    where = cell_centers(grid)
    away = found.clearance.reshape(-1)
    names = sorted(set(part.values()))
    index = {name: k for k, name in enumerate(names)}
    starts = np.array(list(part), int)
    of_start = np.array([index[name] for name in part.values()], int)
    free = away > 0
    weights = neighbours(free.reshape(shape))
    size = float(np.asarray(grid.resolution))
    _, _, source = scipy.sparse.csgraph.dijkstra(
        weights, directed=False, indices=starts, min_only=True, return_predecessors=True
    )
    place = np.full(len(away), -1)
    place[starts] = of_start
    reached = source >= 0
    place[reached] = place[source[reached]]
    doors = []
    for at, one, other in gates:
        ends = tuple(sorted((index[part[one]], index[part[other]])))
        if ends[0] != ends[1]:
            cell = divmod(at, shape[1])
            doors.append(Door(where[at], 2 * float(away[at]), (ends[0], ends[1]), cell))
    return TopologicalMap(
        label=place.reshape(shape),
        center=np.array([_middle(where[starts[of_start == k]]) for k in range(len(names))]),
        area=np.bincount(place[place >= 0], minlength=len(names)) * size**2,
        doors=tuple(doors),
        skeleton=found,
        grid=grid,
    )


def _middle(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """The point, of some, that is nearest to their mean."""
    off = points - points.mean(axis=0)
    return np.asarray(points[np.argmin((off**2).sum(axis=1))])


def cell_centers(grid: Grid) -> Float[np.ndarray, "n 2"]:
    """The centres of all cells in the world [m], row by row."""
    return np.asarray(_centers(grid), np.float64).reshape(-1, 2)


def neighbours(cells: Bool[np.ndarray, "H W"]) -> "scipy.sparse.csr_matrix":
    """The graph of cells and their eight neighbours among them, weighted by distance in cells."""
    height, width = cells.shape
    index = np.arange(height * width).reshape(height, width)
    rows, columns, weights = [], [], []
    for i, j in _HALF:
        here = index[: height - i, max(0, -j) : width - max(0, j)]
        shifted = index[i:, max(0, j) : width - max(0, -j)]
        both = cells.reshape(-1)[here] & cells.reshape(-1)[shifted]
        rows.append(here[both])
        columns.append(shifted[both])
        weights.append(np.full(int(both.sum()), np.hypot(i, j)))
    pairs = np.concatenate(rows), np.concatenate(columns)
    return scipy.sparse.csr_matrix((np.concatenate(weights), pairs), shape=(height * width,) * 2)


class PathPlaces(NamedTuple):
    """Places that cover the poses of a path."""

    center: Int[np.ndarray, "P"]
    """the pose that represents each place"""
    place: Int[np.ndarray, "N"]
    """of each pose: that of the nearest center"""
    adjacent: Bool[np.ndarray, "P P"]


def path_places(poses: ArrayLike, pairs: ArrayLike, *, radius: float) -> PathPlaces:
    """The places of a pose graph: no pose is further than `radius` [m] from its place's center.

    In the order of the poses, one that is further from all centers so far becomes a center. Two
    places are adjacent if an edge of the graph leads from one to the other.

    Args:
        poses: (N, 2 or 3). pairs: (E, 2) of poses that an edge connects, loops included; for a path
            without a graph the pairs (k, k + 1).
    Raises:
        ValueError: on no pose, a radius that is not above 0, or pairs of poses that are none.
    """
    points = np.asarray(poses, np.float64)
    edges = np.asarray(pairs, int).reshape(-1, 2)
    if points.ndim != 2 or len(points) == 0 or not radius > 0:
        raise ValueError(
            f"path_places: expected poses and a radius above 0, got {points.shape} and {radius}"
        )
    if not np.isfinite(points).all():
        raise ValueError("path_places: expected finite poses")
    if len(edges) and not (edges.min() >= 0 and edges.max() < len(points)):
        raise ValueError(f"path_places: expected pairs of {len(points)} poses, got {edges.max()}")
    centers: list[int] = []
    for k, point in enumerate(points[:, :2]):
        if not centers or np.linalg.norm(points[centers, :2] - point, axis=1).min() > radius:
            centers.append(k)
    gap = np.linalg.norm(points[:, None, :2] - points[None, centers, :2], axis=2)
    place = gap.argmin(axis=1)
    adjacent = np.zeros((len(centers),) * 2, bool)
    one, other = place[edges].T
    adjacent[one, other] = adjacent[other, one] = True
    np.fill_diagonal(adjacent, False)
    return PathPlaces(np.array(centers), place, adjacent)
