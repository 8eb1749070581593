"""Named, published experiments with their parameters and figures, one a file."""

from collections.abc import Callable

from jaxslam.simulation.scenarios.circle import circle
from jaxslam.simulation.scenarios.cloister import cloister, cloister_noisy
from jaxslam.simulation.scenarios.explore import explore
from jaxslam.simulation.scenarios.lines import office_lines, square_lines
from jaxslam.simulation.scenarios.loop import loop, loop_bearing
from jaxslam.simulation.scenarios.rooms import ROOMS, circular_room, corridor, office, square
from jaxslam.simulation.scenarios.stationary import stationary
from jaxslam.simulation.scenarios.view import BetweenRanges
from jaxslam.simulation.scenarios.webmap import webmap
from jaxslam.simulation.worlds import Scenario

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
"""By name; each takes the number of steps, and has the published one as default."""

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
    "loop",
    "loop_bearing",
    "office",
    "office_lines",
    "square",
    "square_lines",
    "stationary",
    "webmap",
]
