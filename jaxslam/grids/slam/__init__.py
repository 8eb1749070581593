"""SLAM in occupancy grids: particles with a map each."""

from jaxslam.grids.slam.grid_slam import grid_slam
from jaxslam.grids.slam.particles import GridParticles, best_map

__all__ = ["GridParticles", "best_map", "grid_slam"]
