"""Topological maps: places and doors from a grid, routes, and the place of a particle set."""

from jaxslam._public import publish
from jaxslam.laser.topology._places import (
    Door,
    PathPlaces,
    TopologicalMap,
    path_places,
    topological_map,
)
from jaxslam.laser.topology._planning import Route, place_of, place_weights, route
from jaxslam.laser.topology._voronoi import Skeleton, skeleton

__all__ = [
    "Door",
    "PathPlaces",
    "Route",
    "Skeleton",
    "TopologicalMap",
    "path_places",
    "place_of",
    "place_weights",
    "route",
    "skeleton",
    "topological_map",
]

publish(__name__)
