"""Worlds of publications: circle, cloister, loop and stationary robot, all with point landmarks."""

import dataclasses

import numpy as np

from jaxslam.core._numbers import check_count
from jaxslam.core.protocols import Sensor
from jaxslam.math.stats import sigma_gate
from jaxslam.motion._increments import Increment
from jaxslam.motion._unicycle import Unicycle
from jaxslam.sensors._range_bearing import RangeBearing, RangeBearingNoise
from jaxslam.sensors._relative_position import RelativePosition
from jaxslam.simulation._scans import BetweenRanges
from jaxslam.simulation._worlds import Scenario


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
        filter_options={"correction": "sequential", "gate": sigma_gate(3, 2), "births": 1},
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


_LOOP_SPEED, _LOOP_TURN = 0.25, 0.025
_LOOP_SOURCE = (
    "Huang, Mourikis, Roumeliotis, Observability-based rules for designing consistent EKF SLAM "
    "estimators, IJRR 29(5), 2010"
)


def loop(steps: int = 2500, map_seed: int = 0) -> Scenario:
    """A robot goes round and round a circle of 10 m among 20 random landmarks.

    Δt = 1 s, v = 0.25 m/s, ω = 0.025 rad/s; the odometry has σ_v = σ/√2 and σ_ω = 2√2 σ with
    σ = 0.05 v; landmarks at a uniform angle, 0.5 to 5 m inside or outside the path; relative
    positions with σ = 0.1 m of those 0.5 to 5 m away; P0 = 1e-8 I; joint correction. Huang,
    Mourikis, Roumeliotis 2010. On one draw of their map the authors' own program gave, over 50
    runs, a pose NEES of 3.58 for the ideal EKF, 38.8 standard, 17.5 FEJ and 33.0 OC, and 3.0, 23.8,
    3.3 and 3.5 over 800 steps of another: maps differ a lot, so there is nothing in `published`.

    Args:
        steps: T.
        map_seed: of the landmarks, by NumPy's default generator.
    """
    return _loop("loop", RelativePosition(0.1**2 * np.eye(2)), steps, map_seed)


def loop_bearing(steps: int = 2500, map_seed: int = 0) -> Scenario:
    """`loop` with ranges and bearings, σ_r = 10 % of the range, σ_φ = 10°."""
    noise = RangeBearingNoise(range=0.0, bearing=np.deg2rad(10.0), share=0.1)
    return _loop("loop_bearing", RangeBearing(noise), steps, map_seed)


def loop_landmarks(map_seed: int) -> np.ndarray:
    """The landmarks (20, 2) of a map [m]."""
    draw = np.random.default_rng(map_seed)
    side = np.where(draw.random(20) < 0.5, -1.0, 1.0)
    radius = _LOOP_SPEED / _LOOP_TURN + side * draw.uniform(0.5, 5.0, 20)
    around = draw.uniform(0, 2 * np.pi, 20)
    centre = np.array([0.0, _LOOP_SPEED / _LOOP_TURN])
    return np.asarray(centre + radius[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1))


def _loop(name: str, sensor: Sensor, steps: int, map_seed: int) -> Scenario:
    check_count(f"{name}: steps", steps)
    landmarks = loop_landmarks(map_seed)
    # The true path does not depend on the draw of the noise, so the fullest scan can be counted.
    heading = _LOOP_TURN * np.arange(steps)
    path = np.cumsum(_LOOP_SPEED * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    distance = np.linalg.norm(path[:, None] - landmarks[None], axis=2)
    fullest = int(((distance > 0.5) & (distance < 5)).sum(axis=1).max())
    sigma = 0.05 * _LOOP_SPEED
    return Scenario(
        name=name,
        motion=Unicycle(np.diag([sigma / np.sqrt(2), 2 * np.sqrt(2) * sigma]) ** 2),
        sensor=sensor,
        landmarks=landmarks,
        controls=np.tile([_LOOP_SPEED, _LOOP_TURN, 1.0], (steps, 1)),
        pose_cov=1e-8 * np.eye(3),
        noise_on="odometry",
        visible=BetweenRanges(0.5, 5.0),
        places=max(fullest, 1),
        filter_options={"correction": "joint"},
        source=_LOOP_SOURCE,
    )


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
