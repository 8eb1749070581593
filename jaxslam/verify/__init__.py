"""Verification of hand-derived Jacobians: of a motion model, a sensor, or any function."""

from jaxslam.verify.record import Check, Finding, Report, table
from jaxslam.verify.verifier import build, verify_jacobians

__all__ = ["Check", "Finding", "Report", "build", "table", "verify_jacobians"]
