"""Linearizers: affine approximations of the models, one a file."""

from jaxslam.linearize.at_estimate import AtEstimate
from jaxslam.linearize.at_truth import AtTruth
from jaxslam.linearize.first_estimate import FirstEstimate
from jaxslam.linearize.observability import Observability
from jaxslam.linearize.unscented import Unscented

__all__ = ["AtEstimate", "AtTruth", "FirstEstimate", "Observability", "Unscented"]
