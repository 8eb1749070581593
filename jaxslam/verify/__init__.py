"""Verification of hand-derived Jacobians: of a motion model, a sensor, or any function."""

from jaxslam.verify.findings import Check, Finding, Report, report_table
from jaxslam.verify.verifier import build, verify_jacobians

__all__ = ["Check", "Finding", "Report", "build", "report_table", "verify_jacobians"]
