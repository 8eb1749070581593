"""Linearizers: affine approximations of the models, one a file."""

from jaxslam.linearize.at_estimate import at_estimate
from jaxslam.linearize.at_truth import at_truth
from jaxslam.linearize.first_estimate import first_estimate
from jaxslam.linearize.observability import observability
from jaxslam.linearize.unscented import unscented

__all__ = ["at_estimate", "at_truth", "first_estimate", "observability", "unscented"]
