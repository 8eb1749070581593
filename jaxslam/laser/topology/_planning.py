"""Routes through a topological map, and the place of a pose or of a particle set."""

from typing import NamedTuple

import jax
import numpy as np
import scipy  # its parts load where they are used
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.laser.grids import to_cells
from jaxslam.laser.topology._places import TopologicalMap, cell_centers, neighbours

_to_cells = jax.jit(to_cells, inline=True)


class Route(NamedTuple):
    """The shortest way along the skeleton."""

    places: tuple[int, ...]
    """in the order in which they are passed, the first and the last included"""
    path: Float[np.ndarray, "n 2"]
    """points [m], from the start to the goal"""
    length: float
    """[m]"""


def route(places: TopologicalMap, start: ArrayLike, goal: ArrayLike) -> Route:
    """The shortest way from a point to a goal along the skeleton of a map (Dijkstra).

    From the start to the nearest cell of the skeleton of its place, along the skeleton, and from
    there to the goal; straight if the line between them stays in the place of the start. Raises
    ValueError on a point that is not finite or in no place, and if no way leads to the goal.
    """
    ends = np.stack([np.asarray(start, np.float64)[:2], np.asarray(goal, np.float64)[:2]])
    with refusals_of("route"):
        if not np.isfinite(ends).all():
            raise InvalidField("start, goal", f"expected finite points, got {ends.tolist()}")
        labels = place_of(places, ends)
        for name, end, label in zip(("start", "goal"), ends, labels, strict=True):
            if label < 0:
                raise InvalidField(name, f"{end} is in no place of the map")
    straight = float(np.linalg.norm(ends[1] - ends[0]))
    count = 2 + int(2 * straight / float(places.grid.resolution))  # half a cell apart
    share = np.linspace(0.0, 1.0, count)[:, None]
    crossed = place_of(places, (1 - share) * ends[:1] + share * ends[1:])
    if crossed[0] >= 0 and (crossed == crossed[0]).all():
        return Route((int(labels[0]),), ends, straight)
    cells = places.skeleton.cells.reshape(-1)
    where = cell_centers(places.grid)
    at = []
    for end, label in zip(ends, labels, strict=True):
        cells_of_place = np.flatnonzero(cells & (places.label.reshape(-1) == label))
        at.append(int(cells_of_place[np.argmin(((where[cells_of_place] - end) ** 2).sum(axis=1))]))
    graph = neighbours(places.skeleton.cells)
    distance, before = scipy.sparse.csgraph.dijkstra(
        graph, directed=False, indices=at[0], return_predecessors=True
    )
    if not np.isfinite(distance[at[1]]):
        raise InvalidField(
            "", f"no way leads from place {labels[0]} to place {labels[1]}", owner="route"
        )
    # From the goal back to the start, by the predecessors.
    way = [at[1]]
    while way[-1] != at[0]:
        way.append(int(before[way[-1]]))
    path = np.concatenate([ends[:1], where[way[::-1]], ends[1:]])
    passed = places.label.reshape(-1)[way[::-1]]
    passed = passed[passed >= 0]
    changes = np.flatnonzero(np.diff(passed)) + 1
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    return Route(tuple(int(p) for p in [passed[0], *passed[changes]]), path, length)


def place_of(places: TopologicalMap, points: ArrayLike) -> Int[np.ndarray, "n"]:
    """The place of each point or pose (n, 2 or 3); -1 in a wall, off the map or in no place."""
    table = np.atleast_2d(np.asarray(points, np.float64))
    grid = places.grid
    cell = np.asarray(_to_cells(grid.origin, grid.resolution, table[:, :2]))
    j, i = np.floor(cell).astype(int).T
    height, width = places.label.shape
    inside = (i >= 0) & (j >= 0) & (i < height) & (j < width)
    return np.where(inside, places.label[np.clip(i, 0, height - 1), np.clip(j, 0, width - 1)], -1)


def place_weights(
    places: TopologicalMap, poses: ArrayLike, log_weight: ArrayLike
) -> tuple[Float[np.ndarray, "P"], float]:
    """The probability of each place, the sum of its particles' weights, and of being in no place.

    Args:
        poses: (n, 3) particles. log_weight: (n,) of any scale; -inf for none.
    Raises:
        ValueError: on shapes that do not fit, or without a particle of weight above 0.
    """
    table, logs = np.asarray(poses, np.float64), np.asarray(log_weight, np.float64)
    with refusals_of("place_weights"):
        if table.ndim != 2 or logs.shape != table.shape[:1]:
            raise InvalidField(
                "",
                f"expected particles (n, 3) and log-weights (n,), got {table.shape} and "
                f"{logs.shape}",
            )
        if not np.isfinite(table).all() or not (logs < np.inf).all():
            raise InvalidField("", "expected finite poses, and log-weights below infinity")
        if not len(logs) or not np.isfinite(logs.max()):
            raise InvalidField("", "expected a particle of weight above 0")
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    label = place_of(places, table)
    # The label -1, of no place, is counted first.
    sums = np.bincount(label + 1, weight, minlength=len(places.center) + 1)
    return sums[1:], float(sums[0])
