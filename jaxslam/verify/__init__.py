"""Verification of hand-derived Jacobians: of a motion model, a sensor, or any function."""

from jaxslam._public import publish
from jaxslam.verify._findings import Check, Finding, Report, WorstState, WrongEntry
from jaxslam.verify._verifier import build, verify_jacobians

__all__ = ["Check", "Finding", "Report", "WorstState", "WrongEntry", "build", "verify_jacobians"]

publish(__name__)
