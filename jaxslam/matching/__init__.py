"""Scan matching: where a scan lies on another or on a map, and how well that is known."""

from jaxslam.matching import covariance
from jaxslam.matching.correlative import correlative
from jaxslam.matching.field import field
from jaxslam.matching.icp import IcpSettings, point_to_line, point_to_point
from jaxslam.matching.matcher import Match, Matcher, MatchStatus, match
from jaxslam.matching.points import Points, moved_along_rays, points, raster, transformed
from jaxslam.matching.prior import Prior

__all__ = [
    "IcpSettings",
    "Match",
    "MatchStatus",
    "Matcher",
    "Points",
    "Prior",
    "correlative",
    "covariance",
    "field",
    "match",
    "moved_along_rays",
    "point_to_line",
    "point_to_point",
    "points",
    "raster",
    "transformed",
]
