"""Monte-Carlo campaigns: many filters on identical draws, over blocks, devices and hosts."""

from jaxslam.monte_carlo.campaign import monte_carlo
from jaxslam.monte_carlo.kept import Keep
from jaxslam.monte_carlo.pieces import missing
from jaxslam.monte_carlo.record import Campaign, Interrupted

__all__ = ["Campaign", "Interrupted", "Keep", "missing", "monte_carlo"]
