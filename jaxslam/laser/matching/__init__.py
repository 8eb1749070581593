"""Scan matching: where a scan lies on another or on a map, and how well that is known."""

from jaxslam.laser.matching import covariance
from jaxslam.laser.matching.correlative import Correlative
from jaxslam.laser.matching.field import FieldMatcher
from jaxslam.laser.matching.icp import IcpSettings, PointToLine, PointToPoint
from jaxslam.laser.matching.matcher import Match, Matcher, MatchStatus, match
from jaxslam.laser.matching.point_sets import (
    Points,
    Prior,
    points,
    raster,
    transformed,
)

__all__ = [
    "Correlative",
    "FieldMatcher",
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
    "points",
    "raster",
    "transformed",
]
