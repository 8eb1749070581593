"""Which landmarks stay in the map: managers that a filter asks after every scan."""

from jaxslam.life.existence import existence

__all__ = ["existence"]
