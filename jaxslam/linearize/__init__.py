"""Linearizers: affine approximations of the models, one a file."""

from jaxslam.linearize.first_order import AtEstimate
from jaxslam.linearize.other_points import AtTruth, FirstEstimate, Observability
from jaxslam.linearize.unscented import Unscented

__all__ = ["AtEstimate", "AtTruth", "FirstEstimate", "Observability", "Unscented"]
