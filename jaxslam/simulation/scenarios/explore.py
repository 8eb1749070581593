"""A robot that never comes back: uncertainty grows, and nothing closes a loop."""

import numpy as np

from jaxslam.core.numbers import check_count
from jaxslam.motion.increments import Increment
from jaxslam.sensors.range_bearing import RangeBearing
from jaxslam.simulation.scenarios.view import BetweenRanges
from jaxslam.simulation.worlds import Scenario


def explore(steps: int = 100) -> Scenario:
    """A robot drives straight ahead, 1 m a step, between two rows of landmarks.

    Odometry σ (0.05 m, 1°) a step, ranges and bearings σ (0.1 m, 1°) up to 12 m; landmarks every
    5 m, 4 m to the left and to the right, staggered; P0 = 0. Parameters ours.
    """
    check_count("explore: steps", steps)
    along = np.arange(2.5, max(steps, 6) + 5.0, 5.0)
    left = np.stack([along, np.full_like(along, 4.0)], axis=1)
    right = np.stack([along + 2.5, np.full_like(along, -4.0)], axis=1)
    return Scenario(
        name="explore",
        motion=Increment(np.diag([0.05, np.deg2rad(1.0)]) ** 2),
        sensor=RangeBearing(np.diag([0.1, np.deg2rad(1.0)]) ** 2),
        landmarks=np.concatenate([left, right]),
        controls=np.tile([1.0, 0.0], (steps, 1)),
        visible=BetweenRanges(0.0, 12.0),
        places=12,
        filter_options={"correction": "joint"},
        source="parameters ours",
    )
