"""Rules that decide after each scan which landmarks stay in the map."""

from jaxslam.life.existence import existence
from jaxslam.life.recency import recency

__all__ = ["existence", "recency"]
