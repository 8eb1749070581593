"""Sensors, one a file: those that determine a landmark here, others in `partial` and `absolute`.

The conformance tests run over `REGISTRY`."""

from collections.abc import Callable

from jaxslam.protocols import Sensor
from jaxslam.sensors.absolute import compass, position_fix
from jaxslam.sensors.line import line
from jaxslam.sensors.partial import bearing_inverse_depth, bearing_only, range_only
from jaxslam.sensors.range_bearing import range_bearing
from jaxslam.sensors.range_bearing_signature import range_bearing_signature
from jaxslam.sensors.relative_position import relative_position
from jaxslam.sensors.suite import Part, suite

REGISTRY: dict[str, Callable[..., Sensor]] = {
    "bearing_inverse_depth": bearing_inverse_depth,
    "bearing_only": bearing_only,
    "compass": compass,
    "line": line,
    "position_fix": position_fix,
    "range_bearing": range_bearing,
    "range_bearing_signature": range_bearing_signature,
    "range_only": range_only,
    "relative_position": relative_position,
}

__all__ = [
    "REGISTRY",
    "Part",
    "bearing_inverse_depth",
    "bearing_only",
    "compass",
    "line",
    "position_fix",
    "range_bearing",
    "range_bearing_signature",
    "range_only",
    "relative_position",
    "suite",
]
