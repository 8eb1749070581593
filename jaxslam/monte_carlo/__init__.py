"""Monte-Carlo campaigns: many filters on identical draws, over blocks, devices and hosts."""

from jaxslam.monte_carlo.blockwise import Library
from jaxslam.monte_carlo.campaign import Campaign, Interrupted, Keep, monte_carlo
from jaxslam.monte_carlo.pieces import missing

__all__ = ["Campaign", "Interrupted", "Keep", "Library", "missing", "monte_carlo"]
