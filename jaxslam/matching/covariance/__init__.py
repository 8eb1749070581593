"""Covariances of a match, each of the published ways, to be held against the truth."""

from jaxslam.matching.covariance.along_normals import AlongNormals
from jaxslam.matching.covariance.hessian import Hessian
from jaxslam.matching.covariance.implicit import Implicit
from jaxslam.matching.covariance.lattice import Lattice
from jaxslam.matching.covariance.record import MatchCovariance, MatchedScans, covariance
from jaxslam.matching.covariance.sampling import Sampling, Unscented

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
