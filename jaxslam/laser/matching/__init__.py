"""Scan matching: where a scan lies on another or on a map, and how well that is known."""

from jaxslam.laser.matching import covariance
from jaxslam.laser.matching.correlative import Correlative
from jaxslam.laser.matching.field import FieldMatcher
from jaxslam.laser.matching.icp import Icp, IcpSettings, PointToLine, PointToPoint
from jaxslam.laser.matching.matcher import Match, Matcher, MatchStatus, match
from jaxslam.laser.matching.point_sets import (
    Points,
    Prior,
    moved_along_rays,
    points,
    raster,
    transformed,
)

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
