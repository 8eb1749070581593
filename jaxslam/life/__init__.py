"""Which landmarks stay in the map: rules that are asked after every scan."""

from jaxslam.life.existence import existence
from jaxslam.life.recency import recency

__all__ = ["existence", "recency"]
