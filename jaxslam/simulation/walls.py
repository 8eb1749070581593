"""Rooms with exact walls for a laser: segments and circles, without a grid."""

from jaxslam._public import publish
from jaxslam.simulation._walls import Walls, make_walls, rasterize

__all__ = ["Walls", "make_walls", "rasterize"]

publish(__name__)
