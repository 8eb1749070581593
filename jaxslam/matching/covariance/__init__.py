"""Covariances of a match, each of the published ways, to be held against the truth."""

from jaxslam.matching.covariance.implicit import AlongNormals, Hessian, Implicit
from jaxslam.matching.covariance.record import MatchCovariance, MatchedScans, covariance
from jaxslam.matching.covariance.sampling import Lattice, Sampling, Unscented

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
