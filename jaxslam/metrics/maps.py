"""Errors of maps: of landmarks against a survey, and what a grid leaves open."""

import numpy as np
from jaxtyping import Float

from jaxslam.grids import Grid, entropy
from jaxslam.grids.grid import check_grid
from jaxslam.metrics.paths import alignment, carried
from jaxslam.types import Estimate


def align_map(
    estimate: Estimate, true_points: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """The pose that carries a map onto surveyed points best, and the RMSE [m] that remains.

    estimate: of one time, landmarks tagged. true_points: by tag. The frame of a map made from
    data is that of the robot's start, so only its shape can be compared (`alignment`). Raises
    ValueError if the map is empty.
    """
    named = np.asarray(estimate.alive) & (np.asarray(estimate.tag) >= 0)
    if not named.any():
        raise ValueError("align_map: the map holds no tagged landmark")
    points = np.asarray(estimate.points, np.float64)[named]
    targets = np.asarray(true_points, np.float64)[np.asarray(estimate.tag)[named]]
    pose = alignment(points, targets)
    left = carried(pose, points) - targets
    return pose, float(np.sqrt((left**2).sum(axis=1).mean()))


def map_entropy(grid: Grid) -> float:
    """The mean entropy [bit] of the known cells of a map: 0 sure of each cell, 1 of none.

    Unknown cells, which have 1 bit each (`grids.entropy`), are left out, so that it does not depend
    on how much is around the map. Raises ValueError on a grid that is none or has no known cell.
    """
    check_grid("map_entropy", grid)
    known = np.asarray(grid.log_odds) != 0
    if not known.any():
        raise ValueError("map_entropy: no cell of the map is known")
    return float(np.asarray(entropy(grid), np.float64)[known].mean())
