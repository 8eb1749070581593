"""Sensors, one a file. `REGISTRY` is what the conformance suite runs over."""

from collections.abc import Callable

from jaxslam.protocols import Sensor
from jaxslam.sensors.range_bearing import range_bearing
from jaxslam.sensors.relative_position import relative_position

REGISTRY: dict[str, Callable[..., Sensor]] = {
    "range_bearing": range_bearing,
    "relative_position": relative_position,
}

__all__ = ["REGISTRY", "range_bearing", "relative_position"]
