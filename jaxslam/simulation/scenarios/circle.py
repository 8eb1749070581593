"""UKF-M's 2-D SLAM benchmark: a robot circles inside a ring of landmarks."""

import numpy as np

from jaxslam.core.numbers import check_count
from jaxslam.motion.unicycle import Unicycle
from jaxslam.sensors.relative_position import RelativePosition
from jaxslam.simulation.scenarios.view import BetweenRanges
from jaxslam.simulation.worlds import Scenario


def circle(steps: int = 2500) -> Scenario:
    """A robot circles inside a ring of landmarks: the 2-D SLAM benchmark of UKF-M.

    v = 0.25 m/s, ω = 1.5 °/s, 1 Hz; the odometry is disturbed by (0.05 v/√2 m/s, 0.05 v·2√2 rad/s),
    the robot is not; relative positions with σ = 0.1 m of 20 landmarks on the circle of radius
    v/ω + 3 m about the path's centre, seen between 1 and 5 m; P0 = 0; joint correction. Brossard,
    Barrau, Bonnabel, "A Code for Unscented Kalman Filtering on Manifolds (UKF-M)", ICRA 2020,
    arXiv:2002.00878; `published` are its program's figures over 100 runs,
    and empty where the number of steps is not theirs.
    """
    check_count("circle: steps", steps)
    v, omega = 0.25, np.deg2rad(1.5)
    radius = v / omega
    around = 2 * np.pi * np.arange(20) / 20
    ring = (radius + 3) * np.stack([np.cos(around), np.sin(around)], axis=1)
    landmarks = ring + np.array([0.0, radius])
    # The true path does not depend on the draw, so the fullest scan can be counted beforehand.
    heading = omega * np.arange(steps)
    path = np.cumsum(v * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    distance = np.linalg.norm(path[:, None] - landmarks[None], axis=2)
    names = ("rmse_heading_deg", "rmse_position", "nees_heading", "nees_position")
    figures = {
        "ekf": (3.02, 0.67, 2.88, 2 * 2.56),
        "right_invariant": (2.51, 0.55, 1.01, 2 * 1.17),
        "ukf": (3.01, 0.67, 2.93, 2 * 2.63),
        "ukf_right": (2.51, 0.55, 1.01, 2 * 1.09),
    }
    published = {name: dict(zip(names, row, strict=True)) for name, row in figures.items()}
    fullest = int(((distance > 1) & (distance < 5)).sum(axis=1).max())
    return Scenario(
        name="circle",
        motion=Unicycle(np.diag([0.05 * v / np.sqrt(2), 0.05 * v * 2 * np.sqrt(2)]) ** 2),
        sensor=RelativePosition(0.1**2 * np.eye(2)),
        landmarks=landmarks,
        controls=np.tile([v, omega, 1.0], (steps, 1)),
        noise_on="odometry",
        visible=BetweenRanges(1.0, 5.0),
        places=max(fullest, 1),
        filter_options={"correction": "joint"},
        published=published if steps == 2500 else {},
        source="Brossard, Barrau, Bonnabel, UKF-M, ICRA 2020, arXiv:2002.00878; 100 runs",
    )
