"""Covariances of a match, each of the published ways, to be held against the truth."""

from jaxslam.matching.covariance.along_normals import along_normals
from jaxslam.matching.covariance.hessian import hessian
from jaxslam.matching.covariance.implicit import implicit
from jaxslam.matching.covariance.lattice import lattice
from jaxslam.matching.covariance.record import MatchCovariance, MatchedScans, covariance
from jaxslam.matching.covariance.sampling import sampling, unscented

__all__ = [
    "MatchCovariance",
    "MatchedScans",
    "along_normals",
    "covariance",
    "hessian",
    "implicit",
    "lattice",
    "sampling",
    "unscented",
]
