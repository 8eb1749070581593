"""Grids in which rays are timed."""

import numpy as np

from benchmarks.real_data import DATA
from jaxslam import datasets, grids


def maps():
    """Grids with the maximum range of a laser [m] by name."""
    rng = np.random.default_rng(0)
    cells = rng.random((2000, 2000)) < 1e-4
    for low in range(0, 2000, 250):  # rooms of 12.5 m with doors
        cells[low : low + 3] = cells[:, low : low + 3] = True
    for low in range(100, 2000, 250):
        cells[low : low + 30] = cells[:, low : low + 30] = False
    log_odds = np.where(cells, 4.0, -4.0)
    found = {"2000 × 2000": (grids.Grid(log_odds, np.zeros(3), np.float64(0.05)), 30.0)}
    real = DATA / "maps" / "turtlebot3_world.yaml"
    if real.exists():
        found["turtlebot3_world"] = (datasets.read_map(real), 3.5)
    return found
