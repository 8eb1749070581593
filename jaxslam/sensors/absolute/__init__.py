"""Sensors of the robot's own state in the map, without a landmark."""

from jaxslam.sensors.absolute.absolute import absolute
from jaxslam.sensors.absolute.compass import compass
from jaxslam.sensors.absolute.position_fix import position_fix

__all__ = ["absolute", "compass", "position_fix"]
