"""Iterative closest point: pairs of nearest points and an exact step, again and again."""

from jaxslam.matching.icp.iterations import IcpSettings
from jaxslam.matching.icp.point_to_line import point_to_line
from jaxslam.matching.icp.point_to_point import point_to_point

__all__ = ["IcpSettings", "point_to_line", "point_to_point"]
