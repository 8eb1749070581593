"""Is my Jacobian right? One call over a motion model, a sensor, or any function with a claim."""

from jaxslam.verify.record import Check, Finding, Report, table
from jaxslam.verify.verifier import build, verify_jacobians

__all__ = ["Check", "Finding", "Report", "build", "table", "verify_jacobians"]
