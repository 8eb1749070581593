"""Scan matching: where a scan lies on another or on a map, and how well that is known."""

from jaxslam.matching import covariance
from jaxslam.matching.correlative import Correlative
from jaxslam.matching.field import FieldMatcher
from jaxslam.matching.icp import Icp, IcpSettings, PointToLine, PointToPoint
from jaxslam.matching.matcher import Match, Matcher, MatchStatus, match
from jaxslam.matching.point_sets import Points, Prior, moved_along_rays, points, raster, transformed

__all__ = [
    "Correlative",
    "FieldMatcher",
    "Icp",
    "IcpSettings",
    "Match",
    "MatchStatus",
    "Matcher",
    "PointToLine",
    "PointToPoint",
    "Points",
    "Prior",
    "covariance",
    "match",
    "moved_along_rays",
    "points",
    "raster",
    "transformed",
]
