"""Monte-Carlo campaigns: many filters on identical draws, over blocks, devices and hosts."""

from jaxslam._public import publish
from jaxslam.consistency.campaign._harness import monte_carlo
from jaxslam.consistency.campaign._kept import Keep
from jaxslam.consistency.campaign._remote import Executor, Processes
from jaxslam.consistency.campaign._result import Campaign, Comparison, Incomplete, Interrupted

__all__ = [
    "Campaign",
    "Comparison",
    "Executor",
    "Incomplete",
    "Interrupted",
    "Keep",
    "Processes",
    "monte_carlo",
]

publish(__name__)
