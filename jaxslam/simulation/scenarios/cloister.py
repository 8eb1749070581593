"""The guide's simulation: a robot circles in a square cloister of columns."""

import dataclasses

import numpy as np

from jaxslam.core.numbers import check_count
from jaxslam.math.stats import sigma_gate
from jaxslam.motion.increments import Increment
from jaxslam.sensors.range_bearing import RangeBearing
from jaxslam.simulation.scenarios.view import BetweenRanges
from jaxslam.simulation.worlds import Scenario


def cloister(steps: int = 200) -> Scenario:
    """A robot circles in a square cloister of 36 columns: the guide's simulation, Solà C.3.

    Control (0.1 m, 0.05 rad), σ_u = (0.01 m, 0.02 rad), σ_z = (0.1 m, 1°), every landmark measured
    every step, a 3 σ gate, one landmark initialized a step, start at (0, -2, 0) with P0 = 0.
    The noise is on the robot; `dataclasses.replace(…, noise_on="odometry")` gives the guide's way,
    which disturbs the estimator instead (see the errata).
    """
    check_count("cloister: steps", steps)
    return Scenario(
        name="cloister",
        motion=Increment(np.diag([0.01, 0.02]) ** 2),
        sensor=RangeBearing(np.diag([0.1, np.deg2rad(1.0)]) ** 2),
        landmarks=cloister_landmarks(-4.0, 4.0, 7),
        controls=np.tile([0.1, 0.05], (steps, 1)),
        pose=(0.0, -2.0, 0.0),
        filter_options={"correction": "sequential", "gate": sigma_gate(3), "births": 1},
        source="Solà, EKF-SLAM guide, 2014, appendix C.3",
    )


def cloister_landmarks(low: float, high: float, n: int) -> np.ndarray:
    """The columns (4(2n - 5), 2) of a square cloister with n of them along a side, Solà C.3."""
    outer = np.arange(n - 2) - (n - 3) / 2
    inner = outer[:-1]
    north = np.concatenate(
        [
            np.stack([outer, np.full_like(outer, (n - 1) / 2)], axis=1),
            np.stack([inner, np.full_like(inner, (n - 3) / 2)], axis=1),
        ]
    )
    east = north @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    points = np.concatenate([north, east, -north, -east])
    return points * (high - low) / (n - 1) + (high + low) / 2


def cloister_noisy(steps: int = 400) -> Scenario:
    """`cloister` with 3° a step and a bearing, and three rounds of it: the standard EKF diverges.

    σ_u = (0.05 m, 3°) a step, σ_z = (0.1 m, 3°), landmarks seen up to 3 m, no gate (it would drop
    what the filter has lost). Parameters ours. The divergence is apparent in the sense of
    Fitzgerald 1971 ("Divergence of the Kalman filter", IEEE TAC 16(6)): errors leave the claimed
    covariance by more and more, while themselves they stay bounded. Few runs are `divergent`, which
    counts errors beyond 5 σ of an honest filter.
    """
    return dataclasses.replace(
        cloister(steps),
        name="cloister_noisy",
        motion=Increment(np.diag([0.05, np.deg2rad(3.0)]) ** 2),
        sensor=RangeBearing(np.diag([0.1, np.deg2rad(3.0)]) ** 2),
        visible=BetweenRanges(0.0, 3.0),
        places=14,
        filter_options={"correction": "sequential"},
        source="the world of Solà, EKF-SLAM guide, 2014, appendix C.3; noise ours",
    )
