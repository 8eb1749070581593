"""Occupancy grids: maps, files, distances, rays, beam models, mapping, localization."""

from jaxslam.grids.beam_models import (
    BeamModel,
    LikelihoodField,
    Mixture,
    RayCast,
    fit,
    log_likelihood,
)
from jaxslam.grids.distance import distance_field, gradient
from jaxslam.grids.grid import (
    Field,
    Grid,
    centers,
    check_grid,
    interpolate,
    read_map,
    to_cells,
    write_map,
)
from jaxslam.grids.localization import GridLocalization, beam_log
from jaxslam.grids.mapping import Counts, count, entropy, occupancy, reflection
from jaxslam.grids.pose_clusters import Clusters, clusters
from jaxslam.grids.rays import RayMap, cast, ray_map
from jaxslam.grids.resampling import correlation, crop, resample

__all__ = [
    "BeamModel",
    "Clusters",
    "Counts",
    "Field",
    "Grid",
    "GridLocalization",
    "LikelihoodField",
    "Mixture",
    "RayCast",
    "RayMap",
    "beam_log",
    "cast",
    "centers",
    "check_grid",
    "clusters",
    "correlation",
    "count",
    "crop",
    "distance_field",
    "entropy",
    "fit",
    "gradient",
    "interpolate",
    "log_likelihood",
    "occupancy",
    "ray_map",
    "read_map",
    "reflection",
    "resample",
    "to_cells",
    "write_map",
]
