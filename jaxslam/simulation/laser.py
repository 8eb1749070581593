"""A laser scanner in a world of exact walls, and the information of its scan on the pose."""

from jaxslam._public import publish
from jaxslam.simulation._laser import (
    Laser,
    LaserHistory,
    LaserWorld,
    Observability,
    scan,
    scan_information,
    scan_world,
    true_ranges,
)

__all__ = [
    "Laser",
    "LaserHistory",
    "LaserWorld",
    "Observability",
    "scan",
    "scan_information",
    "scan_world",
    "true_ranges",
]

publish(__name__)
