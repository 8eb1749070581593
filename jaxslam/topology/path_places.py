"""Places of a path or a pose graph: poses in groups, adjacent where the robot went between them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from numpy.typing import ArrayLike


class PathPlaces(NamedTuple):
    """Places that cover the poses of a path."""

    center: Int[np.ndarray, "P"]
    """the pose that stands for each place"""
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
