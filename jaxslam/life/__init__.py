"""Which landmarks stay in the map: managers that a filter asks after every scan."""

from jaxslam.life.existence import existence
from jaxslam.life.recency import recency

__all__ = ["existence", "recency"]
