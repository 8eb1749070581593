"""Relocalization of a lost robot in its map by geometric matching of one scan."""

from jaxslam._public import publish
from jaxslam.filters.map_management._relocalization import (
    lost,
    points_of_map,
    relocalize,
    relocated,
    seen_points,
)

__all__ = ["lost", "points_of_map", "relocalize", "relocated", "seen_points"]

publish(__name__)
