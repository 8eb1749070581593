"""Monte-Carlo campaigns: many filters on identical draws, over blocks, devices and hosts."""

from jaxslam.consistency.campaign.harness import monte_carlo
from jaxslam.consistency.campaign.kept import Keep
from jaxslam.consistency.campaign.pieces import missing
from jaxslam.consistency.campaign.remote import Processes
from jaxslam.consistency.campaign.result import Campaign, Incomplete, Interrupted

__all__ = ["Campaign", "Incomplete", "Interrupted", "Keep", "Processes", "missing", "monte_carlo"]
