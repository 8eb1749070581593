"""Sensors of the robot's own state in the map, without a landmark."""

from jaxslam.sensors.absolute.absolute import Absolute
from jaxslam.sensors.absolute.compass import Compass
from jaxslam.sensors.absolute.position_fix import PositionFix

__all__ = ["Absolute", "Compass", "PositionFix"]
