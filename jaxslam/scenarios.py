"""Named, published experiments with their parameters and figures, and the filters put to them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.charts.right_invariant import right_invariant
from jaxslam.filters.ekf_slam import ekf_slam
from jaxslam.linalg import check_count
from jaxslam.linearize.at_truth import at_truth
from jaxslam.motion.increment import increment
from jaxslam.motion.unicycle import unicycle
from jaxslam.protocols import Filter
from jaxslam.sensors.range_bearing import range_bearing
from jaxslam.sensors.relative_position import relative_position
from jaxslam.simulate import Scenario
from jaxslam.stats import sigma_gate
from jaxslam.types import Truth


def circle(steps: int = 2500) -> Scenario:
    """A robot circles inside a ring of landmarks: the 2-D SLAM benchmark of UKF-M.

    v = 0.25 m/s, ω = 1.5 °/s, 1 Hz; the odometry is disturbed by (0.05 v/√2 m/s, 0.05 v·2√2 rad/s),
    the robot is not; relative positions with σ = 0.1 m of 20 landmarks on the circle of radius
    v/ω + 3 m about the path's centre, seen between 1 and 5 m; P0 = 0; joint correction. Brossard,
    Barrau, Bonnabel, "A Code for Unscented Kalman Filtering on Manifolds (UKF-M)", ICRA 2020,
    arXiv:2002.00878; `published` are its program's figures for the EKF over 100 runs,
    and empty where the number of steps is not theirs.
    """
    check_count("steps", steps)
    v, omega = 0.25, np.deg2rad(1.5)
    radius = v / omega
    around = 2 * np.pi * np.arange(20) / 20
    ring = (radius + 3) * np.stack([np.cos(around), np.sin(around)], axis=1)
    landmarks = ring + np.array([0.0, radius])
    # The true path does not depend on the draw, so the fullest scan can be counted beforehand.
    heading = omega * np.arange(steps)
    path = np.cumsum(v * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    distance = np.linalg.norm(path[:, None] - landmarks[None], axis=2)
    published = {
        "rmse_heading_deg": 3.02,
        "rmse_position": 0.67,
        "nees_heading": 2.88,
        "nees_position": 2 * 2.56,
    }
    fullest = int(((distance > 1) & (distance < 5)).sum(axis=1).max())
    return Scenario(
        name="circle",
        motion=unicycle(np.diag([0.05 * v / np.sqrt(2), 0.05 * v * 2 * np.sqrt(2)]) ** 2),
        sensor=relative_position(0.1**2 * np.eye(2)),
        landmarks=landmarks,
        controls=np.tile([v, omega, 1.0], (steps, 1)),
        noise_on="odometry",
        visible=between_ranges(1.0, 5.0),
        places=max(fullest, 1),
        filter_options={"update": "joint"},
        published=published if steps == 2500 else {},
        source="Brossard, Barrau, Bonnabel, UKF-M, ICRA 2020, arXiv:2002.00878; EKF, 100 runs",
    )


def cloister(steps: int = 200) -> Scenario:
    """A robot circles in a square cloister of 36 columns: the guide's simulation, Solà C.3.

    Control (0.1 m, 0.05 rad), σ_u = (0.01 m, 0.02 rad), σ_z = (0.1 m, 1°), every landmark measured
    every step, a 3 σ gate, one landmark initialized a step, start at (0, -2, 0) with P0 = 0.
    The noise is on the robot; `dataclasses.replace(…, noise_on="odometry")` gives the guide's way,
    which disturbs the estimator instead (see ERRATA).
    """
    check_count("steps", steps)
    return Scenario(
        name="cloister",
        motion=increment(np.diag([0.01, 0.02]) ** 2),
        sensor=range_bearing(np.diag([0.1, np.deg2rad(1.0)]) ** 2),
        landmarks=cloister_landmarks(-4.0, 4.0, 7),
        controls=np.tile([0.1, 0.05], (steps, 1)),
        pose=(0.0, -2.0, 0.0),
        filter_options={"update": "sequential", "gate": sigma_gate(3), "births": 1},
        source="Solà, SLAM with the extended Kalman filter, 2014, appendix C.3",
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


def between_ranges(nearest: float, farthest: float) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """A field of view all around, from nearest to farthest metres (both excluded)."""

    def visible(pose: jax.Array, landmark: jax.Array) -> jax.Array:
        squared = jnp.sum((landmark[:2] - pose[:2]) ** 2)
        return (squared > nearest**2) & (squared < farthest**2)

    return visible


SCENARIOS: dict[str, Callable[..., Scenario]] = {"circle": circle, "cloister": cloister}
"""By name; each takes the number of steps, and has the published one as default."""

Candidate = Filter | Callable[[Truth], Filter]
"""A filter, or for filters that need it, a function of the truth of the run."""


def _ekf(scenario: Scenario) -> Candidate:
    return _ekf_slam(scenario)


def _right_invariant(scenario: Scenario) -> Candidate:
    return _ekf_slam(scenario, chart=right_invariant())


def _iterated(scenario: Scenario) -> Candidate:
    return _ekf_slam(scenario, iterations=3)


def ideal(scenario: Scenario) -> Callable[[Truth], Filter]:
    """The EKF with Jacobians at the truth, of the scenario's own set-up."""
    start = jnp.asarray(scenario.pose, float)
    return lambda truth: _ekf_slam(scenario, linearize=at_truth(truth, start))


def _ekf_slam(scenario: Scenario, **variant: Any) -> Filter:
    capacity = int(np.shape(scenario.landmarks)[0])
    options: dict[str, Any] = scenario.filter_options | variant
    return ekf_slam(scenario.motion, scenario.sensor, capacity, **options)


FILTERS: dict[str, Callable[[Scenario], Candidate]] = {
    "ekf": _ekf,
    "iterated": _iterated,
    "right_invariant": _right_invariant,
    "ideal": ideal,
}
"""By name; each takes the scenario and returns what `monte_carlo` runs on it."""
