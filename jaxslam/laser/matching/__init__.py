"""Scan matching: where a scan lies on another or on a map, and how well that is known."""

from jaxslam._public import publish
from jaxslam.laser.matching import covariance
from jaxslam.laser.matching._correlative import Correlative
from jaxslam.laser.matching._field import FieldMatcher
from jaxslam.laser.matching._icp import IcpSettings, PointToLine, PointToPoint
from jaxslam.laser.matching._matcher import Match, Matcher, MatchStatus, match
from jaxslam.laser.matching._point_sets import Points, Prior, points, raster, transformed

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

publish(__name__)
