"""Covariances of a match, by the published methods."""

from jaxslam._public import publish
from jaxslam.laser.matching.covariance._implicit import AlongNormals, Hessian, Implicit
from jaxslam.laser.matching.covariance._match_covariance import (
    MatchCovariance,
    MatchedScans,
    covariance,
)
from jaxslam.laser.matching.covariance._sampling import Lattice, Sampling, Unscented

__all__ = [
    "AlongNormals",
    "Hessian",
    "Implicit",
    "Lattice",
    "MatchCovariance",
    "MatchedScans",
    "Sampling",
    "Unscented",
    "covariance",
]

publish(__name__)
