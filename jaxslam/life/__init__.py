"""Rules that decide after each scan which landmarks stay in the map."""

from jaxslam.life.existence import Existence
from jaxslam.life.recency import Recency

__all__ = ["Existence", "Recency"]
