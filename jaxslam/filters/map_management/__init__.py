"""Map management: pruning, merging of duplicates, loop closure, relocalization."""

from jaxslam.filters.map_management import relocalization

__all__ = ["relocalization"]
