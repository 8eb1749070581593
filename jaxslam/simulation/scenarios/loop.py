"""The simulation of the observability-constrained filters: odometry round a ring of landmarks."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.numbers import check_count
from jaxslam.core.protocols import Sensor
from jaxslam.motion.unicycle import Unicycle
from jaxslam.sensors.range_bearing import RangeBearing
from jaxslam.sensors.relative_position import RelativePosition
from jaxslam.simulation.scenarios.view import BetweenRanges
from jaxslam.simulation.worlds import Scenario

_SPEED, TURN = 0.25, 0.025
_SOURCE = (
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
    return _loop("loop_bearing", RangeBearing(_noise_cov), steps, map_seed)


def _noise_cov(z: jax.Array) -> jax.Array:
    return jnp.diag(jnp.stack([0.1 * z[0], jnp.full_like(z[0], np.deg2rad(10.0))]) ** 2)


def loop_landmarks(map_seed: int) -> np.ndarray:
    """The landmarks (20, 2) of a map [m]."""
    draw = np.random.default_rng(map_seed)
    side = np.where(draw.random(20) < 0.5, -1.0, 1.0)
    radius = _SPEED / TURN + side * draw.uniform(0.5, 5.0, 20)
    around = draw.uniform(0, 2 * np.pi, 20)
    centre = np.array([0.0, _SPEED / TURN])
    return np.asarray(centre + radius[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1))


def _loop(name: str, sensor: Sensor, steps: int, map_seed: int) -> Scenario:
    check_count(f"{name}: steps", steps)
    landmarks = loop_landmarks(map_seed)
    # The true path does not depend on the draw of the noise, so the fullest scan can be counted.
    heading = TURN * np.arange(steps)
    path = np.cumsum(_SPEED * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    distance = np.linalg.norm(path[:, None] - landmarks[None], axis=2)
    fullest = int(((distance > 0.5) & (distance < 5)).sum(axis=1).max())
    sigma = 0.05 * _SPEED
    return Scenario(
        name=name,
        motion=Unicycle(np.diag([sigma / np.sqrt(2), 2 * np.sqrt(2) * sigma]) ** 2),
        sensor=sensor,
        landmarks=landmarks,
        controls=np.tile([_SPEED, TURN, 1.0], (steps, 1)),
        pose_cov=1e-8 * np.eye(3),
        noise_on="odometry",
        visible=BetweenRanges(0.5, 5.0),
        places=max(fullest, 1),
        filter_options={"correction": "joint"},
        source=_SOURCE,
    )
