"""Occupancy grids: the map and its files, distance fields, rays, beam models, mapping."""

from jaxslam.grids.cast import RayMap, cast, ray_map
from jaxslam.grids.distance import distance_field, gradient
from jaxslam.grids.files import read_map, write_map
from jaxslam.grids.grid import Field, Grid, centers, check_grid, to_cells
from jaxslam.grids.interpolation import interpolate
from jaxslam.grids.resampling import correlation, crop, resample

__all__ = [
    "Field",
    "Grid",
    "RayMap",
    "cast",
    "centers",
    "check_grid",
    "correlation",
    "crop",
    "distance_field",
    "gradient",
    "interpolate",
    "ray_map",
    "read_map",
    "resample",
    "to_cells",
    "write_map",
]
