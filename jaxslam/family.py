"""The family: every variant of the one EKF-SLAM by name, set up for a scenario.

A variant is a chart, a linearizer or an option, given in one line; `monte_carlo` and the command
line run them side by side.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxslam.charts.left_invariant import left_invariant
from jaxslam.charts.right_invariant import right_invariant
from jaxslam.charts.robocentric import robocentric
from jaxslam.filters.ekf_slam import ekf_slam
from jaxslam.linearize.at_truth import at_truth
from jaxslam.linearize.first_estimate import first_estimate
from jaxslam.linearize.observability import observability
from jaxslam.linearize.unscented import unscented
from jaxslam.protocols import Candidate, Filter
from jaxslam.simulate import Scenario
from jaxslam.types import Truth


def variant(scenario: Scenario, **options: Any) -> Filter:
    """EKF-SLAM set up as the scenario says, but for these arguments of `filters.ekf_slam`."""
    capacity = int(np.shape(scenario.landmarks)[0])
    return ekf_slam(
        scenario.motion, scenario.sensor, capacity, **(scenario.filter_options | options)
    )


def ideal(scenario: Scenario, **options: Any) -> Callable[[Truth], Filter]:
    """The EKF with Jacobians at the truth: a function of the truth that returns a filter."""
    return lambda truth: variant(scenario, linearize=at_truth(truth), **options)


FILTERS: dict[str, Callable[..., Candidate]] = {
    "ekf": variant,
    "ideal": ideal,
    "iterated": lambda world, **more: variant(world, iterations=3, **more),
    "fej": lambda world, **more: variant(world, linearize=first_estimate(), **more),
    "oc": lambda world, **more: variant(world, linearize=observability(), **more),
    "right_invariant": lambda world, **more: variant(world, chart=right_invariant(), **more),
    "left_invariant": lambda world, **more: variant(world, chart=left_invariant(), **more),
    "robocentric": lambda world, **more: variant(world, chart=robocentric(), **more),
    "ukf": lambda world, **more: variant(world, linearize=unscented(), **more),
    "ukf_right": lambda world, **more: variant(
        world, chart=right_invariant(), linearize=unscented(), **more
    ),
    "ukf_left": lambda world, **more: variant(
        world, chart=left_invariant(), linearize=unscented(), **more
    ),
    "square_root": lambda world, **more: variant(world, square_root=True, **more),
}
"""By name; each takes a scenario, and further options of `ekf_slam`, and returns what `monte_carlo`
runs on it."""
