"""Sensors of which one measurement does not determine a landmark: bearing or range alone."""

from jaxslam.sensors.partial.bearing_inverse_depth import BearingInverseDepth
from jaxslam.sensors.partial.bearing_only import BearingOnly
from jaxslam.sensors.partial.range_only import RangeOnly

__all__ = ["BearingInverseDepth", "BearingOnly", "RangeOnly"]
