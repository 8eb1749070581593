"""A robot that does not move, and one landmark: its heading is not observable."""

import numpy as np

from jaxslam.core.numbers import check_count
from jaxslam.motion.unicycle import Unicycle
from jaxslam.sensors.range_bearing import RangeBearing
from jaxslam.simulation.worlds import Scenario


def stationary(steps: int = 300) -> Scenario:
    """A robot at rest measures one landmark, 10 m away, at every step.

    It knows its pose to (0.5 m, 0.5 m, 5°), ranges and bearings to (0.5 m, 5°), and has no process
    noise. The robot gets no information on the pose, so its covariance must not change; a filter
    that linearizes at each new estimate shrinks it. After Julier & Uhlmann, "A counter example to
    the theory of simultaneous localization and map building", ICRA 2001; the figures are ours.
    """
    check_count("stationary: steps", steps)
    return Scenario(
        name="stationary",
        motion=Unicycle(np.zeros((2, 2))),
        sensor=RangeBearing(np.diag([0.5, np.deg2rad(5.0)]) ** 2),
        landmarks=[[8.0, 6.0]],
        controls=np.tile([0.0, 0.0, 1.0], (steps, 1)),
        pose_cov=np.diag([0.5, 0.5, np.deg2rad(5.0)]) ** 2,
        source="after Julier & Uhlmann, ICRA 2001; parameters ours",
    )
