"""Named, published experiments with their parameters and figures."""

from collections.abc import Callable

from jaxslam._public import publish
from jaxslam.simulation._scans import BetweenRanges
from jaxslam.simulation._worlds import Scenario
from jaxslam.simulation.scenarios._drives import explore, webmap
from jaxslam.simulation.scenarios._published import (
    circle,
    cloister,
    cloister_noisy,
    loop,
    loop_bearing,
    stationary,
)
from jaxslam.simulation.scenarios._rooms import (
    ROOMS,
    circular_room,
    corridor,
    from_start,
    office,
    office_lines,
    square,
    square_lines,
)

SCENARIOS: dict[str, Callable[..., Scenario]] = {
    "circle": circle,
    "cloister": cloister,
    "cloister_noisy": cloister_noisy,
    "explore": explore,
    "loop": loop,
    "loop_bearing": loop_bearing,
    "office_lines": office_lines,
    "square_lines": square_lines,
    "stationary": stationary,
    "webmap": webmap,
}
"""By name; each takes the number of steps, by default that of the publication."""

__all__ = [
    "ROOMS",
    "SCENARIOS",
    "BetweenRanges",
    "circle",
    "circular_room",
    "cloister",
    "cloister_noisy",
    "corridor",
    "explore",
    "from_start",
    "loop",
    "loop_bearing",
    "office",
    "office_lines",
    "square",
    "square_lines",
    "stationary",
    "webmap",
]

publish(__name__)
