"""Worlds of this project: a straight drive without a loop, and a car after Bailey et al."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.validation import at_least, or_none, refusals_of, require
from jaxslam.motion._ackermann import Ackermann
from jaxslam.motion._increments import Increment
from jaxslam.motion._substeps import Substeps
from jaxslam.sensors._range_bearing import RangeBearing
from jaxslam.simulation._scans import BetweenRanges
from jaxslam.simulation._worlds import Scenario


def explore(steps: int = 100) -> Scenario:
    """A robot drives straight ahead, 1 m a step, between two rows of landmarks.

    Odometry σ (0.05 m, 1°) a step, ranges and bearings σ (0.1 m, 1°) up to 12 m; landmarks every
    5 m, 4 m to the left and to the right, staggered; P0 = 0. Parameters ours.
    """
    with refusals_of("explore"):
        require("steps", steps, at_least(1))
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


_SPEED, _WHEELBASE = 3.0, 4.0
_INTERVAL, _SUBSTEPS = 0.025, 8
_STEERING, _STEERING_RATE = math.radians(30), math.radians(20)
_FARTHEST, _ARRIVED = 30.0, 1.0

_WAYPOINTS = (
    *((0.0, 0.0), (22, -4), (45, -2), (66, 6), (82, 22), (88, 44), (78, 63), (58, 69)),
    *((40, 60), (24, 50), (6, 54), (-12, 64), (-30, 58), (-37, 38), (-34, 18), (-20, 4)),
)
_LANDMARKS = (
    *((-2, 13), (8, -8), (22, 12), (24, -11), (35, -8), (52, -7), (49, 8), (58, 13), (63, 23)),
    *((89, 10), (91, 20), (82, 35), (82, 45), (102, 58), (90, 64), (76, 79), (64, 73), (54, 73)),
    *((36, 76), (46, 50), (24, 59), (29, 44), (12, 45), (9, 59), (-4, 55), (-4, 77), (-16, 55)),
    *((-33, 63), (-21, 46), (-29, 45), (-32, 35), (-48, 24), (-49, 15), (-27, 4), (-13, 16)),
    *((-14, -5),),
)


def webmap(steps: int | None = None, loops: int = 2) -> Scenario:
    """A steered car drives loops of 340 m among 36 landmarks, and sees those ahead.

    After Bailey, Nieto, Guivant, Stevens, Nebot, "Consistency of the EKF-SLAM Algorithm", IROS
    2006, and Bailey's simulator: 3 m/s, wheelbase 4 m, steering within ±30° and 20 °/s; a control
    every Δt = 0.025 s, disturbed by σ_V = 0.3 m/s and σ_G = 3°, white; every 0.2 s a scan of the
    landmarks within 30 m and ahead, |bearing| < 90°, with σ_r = 0.1 m and σ_b = 1°; known
    association. The noise is on the odometry: the car follows its waypoints by its true pose, so
    the true path is one and the same in every run. P0 = 0; joint correction.

    The map is **ours**, in the style of theirs, which the paper draws and does not list: 36
    landmarks and 16 waypoints in 150 m by 90 m. So is the car in one respect: the pose is that of
    its rear axle, moved along exact arcs (`motion.Ackermann`), where theirs takes Euler steps
    along the steered front wheel. Hence `published` is empty.

    Args:
        steps: scans, the rows of the log; a row holds the 8 controls that lead to its scan.
            Default: as many as the loops take.
        loops: how often the car goes around, where steps is not given; each takes 566 scans.
    Raises:
        ValueError: if steps or loops is not an integer >= 1.
    """
    with refusals_of("webmap"):
        require("loops", loops, at_least(1))
        require("steps", steps, or_none(at_least(1)))
    landmarks = np.array(_LANDMARKS, np.float64)
    steering, path = _drive(steps, loops)
    scans = path[_SUBSTEPS::_SUBSTEPS]
    controls = np.empty((len(scans), _SUBSTEPS, 3))
    controls[..., 0] = _SPEED
    controls[..., 1] = steering.reshape(-1, _SUBSTEPS)
    controls[..., 2] = _INTERVAL
    offset = landmarks - scans[:, None, :2]
    ahead = offset[..., 0] * np.cos(scans[:, 2:]) + offset[..., 1] * np.sin(scans[:, 2:]) > 0
    fullest = int((ahead & (np.hypot(offset[..., 0], offset[..., 1]) < _FARTHEST)).sum(1).max())
    car = Ackermann(
        np.diag([0.3, math.radians(3)]) ** 2,
        wheelbase=_WHEELBASE,
        sensor=(0.0, 0.0),
        encoder=0.0,
    )
    return Scenario(
        name="webmap",
        motion=Substeps(car, _SUBSTEPS),
        sensor=RangeBearing(np.diag([0.1, math.radians(1)]) ** 2),
        landmarks=landmarks,
        controls=controls.reshape(len(scans), -1),
        pose=path[0],
        noise_on="odometry",
        visible=_is_visible,
        places=fullest,
        filter_options={"correction": "joint"},
        source='after Bailey et al., "Consistency of the EKF-SLAM Algorithm", IROS 2006; our map',
    )


def _is_visible(pose: jax.Array, landmark: jax.Array) -> jax.Array:
    """The field of view: within 30 m, in the half-plane ahead of the robot."""
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    ahead = dx * jnp.cos(pose[2]) + dy * jnp.sin(pose[2]) > 0
    return ahead & (dx**2 + dy**2 < _FARTHEST**2)


def _drive(steps: int | None, loops: int) -> tuple[np.ndarray, np.ndarray]:
    """The steering (n,) and the poses (n+1, 3) of whole scans: `steps`, or all that `loops` take.

    From the first waypoint, along the chord of its neighbours, the car steers for the next one, and
    for the next one when within 1 m. A loop ends within 1 m of the first waypoint.
    """
    (x, y), before, after = _WAYPOINTS[0], _WAYPOINTS[-1], _WAYPOINTS[1]
    theta = math.atan2(after[1] - before[1], after[0] - before[0])
    alpha, target = 0.0, 1
    steering: list[float] = []
    poses = [(x, y, theta)]
    while True:
        aim = _WAYPOINTS[target % len(_WAYPOINTS)]
        if math.hypot(aim[0] - x, aim[1] - y) < _ARRIVED:
            target += 1
            aim = _WAYPOINTS[target % len(_WAYPOINTS)]
        finished = target > loops * len(_WAYPOINTS)
        if len(steering) % _SUBSTEPS == 0 and (
            finished if steps is None else len(steering) == steps * _SUBSTEPS
        ):
            return np.array(steering), np.array(poses)
        error = _wrap(math.atan2(aim[1] - y, aim[0] - x) - theta - alpha)
        alpha += _clip(error, _STEERING_RATE * _INTERVAL)
        alpha = _clip(alpha, _STEERING)
        # pose ∘ exp(VΔt, 0, turn): the chord of an arc leaves at half its turn.
        turn = _SPEED * _INTERVAL * math.tan(alpha) / _WHEELBASE
        chord = _SPEED * _INTERVAL * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)
        x, y = x + chord * math.cos(theta + turn / 2), y + chord * math.sin(theta + turn / 2)
        theta = _wrap(theta + turn)
        steering.append(alpha)
        poses.append((x, y, theta))


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def _clip(value: float, bound: float) -> float:
    return max(-bound, min(bound, value))
