"""Linearizers: where a filter's Jacobians are taken."""

from jaxslam.linearize.at_estimate import at_estimate
from jaxslam.linearize.at_truth import at_truth

__all__ = ["at_estimate", "at_truth"]
