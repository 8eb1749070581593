"""Sensors of which one measurement does not determine a landmark: bearing or range alone."""

from jaxslam.sensors.partial.bearing_inverse_depth import bearing_inverse_depth
from jaxslam.sensors.partial.bearing_only import bearing_only
from jaxslam.sensors.partial.range_only import range_only

__all__ = ["bearing_inverse_depth", "bearing_only", "range_only"]
