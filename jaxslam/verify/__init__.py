"""Verification of hand-derived Jacobians: of a motion model, a sensor, or any function."""

from jaxslam.verify._findings import Check, Finding, Report
from jaxslam.verify._verifier import verify_jacobians

__all__ = ["Check", "Finding", "Report", "verify_jacobians"]
