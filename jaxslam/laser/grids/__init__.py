"""Occupancy grids: maps, files, distances, rays, beam models, mapping, localization."""

from jaxslam._public import publish
from jaxslam.laser.grids._cell_counts import Counts, count, entropy, occupancy, reflection
from jaxslam.laser.grids._distance import distance_field, gradient
from jaxslam.laser.grids._grid import (
    Field,
    Grid,
    centers,
    interpolate,
    to_cells,
)
from jaxslam.laser.grids._grid_localization import GridLocalization, beam_log
from jaxslam.laser.grids._pose_clusters import Clusters, clusters
from jaxslam.laser.grids._rays import RayMap, cast, ray_map
from jaxslam.laser.grids._resolution import correlation, crop, resample
from jaxslam.laser.grids.beam_models import (
    BeamModel,
    LikelihoodField,
    Mixture,
    RayCast,
    fit,
    log_likelihood,
)

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
    "reflection",
    "resample",
    "to_cells",
]

publish(__name__)
