"""Linearizers: affine approximations of the models, one a file."""

from jaxslam._public import publish
from jaxslam.linearize._first_order import (
    AtEstimate,
    invert_jacobians,
    motion_jacobians,
    observe_jacobians,
)
from jaxslam.linearize._other_points import AtTruth, FirstEstimate, Observability
from jaxslam.linearize._unscented import Unscented

__all__ = [
    "AtEstimate",
    "AtTruth",
    "FirstEstimate",
    "Observability",
    "Unscented",
    "invert_jacobians",
    "motion_jacobians",
    "observe_jacobians",
]

publish(__name__)
