"""Iterative closest point: pairs of nearest points and an exact step, again and again."""

from jaxslam.matching.icp.iterations import IcpSettings
from jaxslam.matching.icp.point_to_line import PointToLine
from jaxslam.matching.icp.point_to_point import PointToPoint

__all__ = ["IcpSettings", "PointToLine", "PointToPoint"]
