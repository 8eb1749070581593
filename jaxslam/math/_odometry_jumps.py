"""Steps of a path that are no motion: odometry that was set to zero, or to another pose, on the
way, and a tracker that lost the robot."""

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.math import numpy_poses as poses

_POSSIBLE = np.array([3.0, np.pi])
"""Speed [m/s] and turn rate [rad/s] up to which any step may be motion."""
_LEAST = np.array([0.3, 0.35])  # 0.35 rad is 20°
"""Step [m] and turn [rad] up to which the timing of messages is too coarse to tell a speed."""
_TIMES_USUAL = 8.0
"""Times the usual largest speed above which a step is no motion. MIT CSAIL, with rough stamps and
fast turns, reaches 2 in speed and 5 in turn rate."""
_TIMES_USUAL_TO_ZERO = 2.0
"""The same of a step that ends at the pose zero, where a restarted driver begins."""
_MIN_STEPS = 5
"""Steps with motion that tell a usual speed."""
LONG = 10.0
"""Median intervals between two messages above which nothing is interpolated in between."""


def odometry_jumps(
    path: Float[np.ndarray, "n 3"], time: Float[np.ndarray, "n"] | None
) -> Bool[np.ndarray, "n"]:
    """Mask of the poses of odometry that no motion from the previous one leads to; never the first.

    The usual speed, and turn rate, is the 95 % quantile of those steps of the log that are not
    faster than 3 m/s, 180°/s; of all of them if most are faster. A step is a jump if its speed or
    its turn rate is above that limit and above 8 times the usual one. So is a step that ends within
    two usual steps of (0, 0, 0), if it is faster than twice the usual, or longer than ten median
    intervals. Steps below 0.3 m and 20° are never jumps. An interval shorter than the median counts
    as the median, since the stamps of messages may bunch.

    Args:
        time: [s] of each pose. None, or no two that increase: a step takes one unit of time, and
            its speed has no limit.
    """
    size = step_sizes(path)[1:]
    jump = np.zeros(len(path), bool)
    if not len(size):
        return jump
    interval = np.zeros(len(size)) if time is None else np.diff(time)
    timed = bool((interval > 0).any())
    median = float(np.median(interval[interval > 0])) if timed else 1.0
    speed = size / np.maximum(interval, median)[:, None]
    limit = _POSSIBLE if timed else np.zeros(2)
    usual = np.array(
        [_usual_speed(speed[:, k], _POSSIBLE[k] if timed else np.inf) for k in range(2)]
    )
    is_large = size > _LEAST
    jump[1:] = (is_large & (speed > np.maximum(limit, _TIMES_USUAL * usual))).any(axis=1)
    at_zero = np.stack([np.hypot(path[:, 0], path[:, 1]), np.abs(poses.wrapped(path[:, 2]))], 1)
    zero = (at_zero <= np.minimum(2 * usual * median, _LEAST) + 1e-9).all(axis=1)
    fast = (speed > _TIMES_USUAL_TO_ZERO * usual) | (interval > LONG * median)[:, None]
    jump[1:] |= zero[1:] & ~zero[:-1] & (is_large & fast).any(axis=1)
    return jump


def lost_lines(
    path: Float[np.ndarray, "n 3"], jump: Bool[np.ndarray, "n"]
) -> Bool[np.ndarray, "n"]:
    """Mask of the lines of a true path that a tracker wrote while it had lost the robot.

    It repeats a pose, its last one or zero, so that the path jumps before or after. Lost are lines
    that repeat the pose before a jump, but for the first of them, lines that repeat the pose after
    a jump, and a pose alone between two jumps.

    Args:
        jump: of each line, as from `odometry_jumps`.
    """
    lost = np.zeros(len(path), bool)
    changes = [0, *np.flatnonzero((path[1:] != path[:-1]).any(axis=1)) + 1, len(path)]
    for begin, end in pairwise(changes):  # lines of one pose
        before, after = jump[begin], end < len(path) and jump[end]
        lost[begin:end] = before and (after or end - begin > 1)
        lost[begin + 1 : end] |= after
    return lost


def without_jumps(
    path: Float[np.ndarray, "n 3"], jump: Bool[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """The path in which each jump is a step equal to the one before it, and zero at the start."""
    steps = poses.between(path[:-1], path[1:])
    for k in np.flatnonzero(jump[1:]):
        steps[k] = steps[k - 1] if k else 0.0
    return poses.chain(path[0], steps)


def step_sizes(path: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Distance and absolute turn of the step to each pose from the previous one; first zero."""
    step = np.zeros((len(path), 3))
    step[1:] = poses.between(path[:-1], path[1:])
    return np.stack([np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])], axis=1)


def _usual_speed(speed: Float[np.ndarray, "n"], possible: float) -> float:
    """The 95 % quantile of the speeds of steps with motion, without impossible ones if these are
    few. Of fewer than `_MIN_STEPS` zero in a log at rest, whose limit then counts alone; else ∞."""
    moving = speed[speed > 1e-9]
    if len(moving) < _MIN_STEPS:
        at_rest = len(speed) >= 4 * _MIN_STEPS and np.isfinite(possible)
        return 0.0 if at_rest else np.inf
    slow = moving[moving <= possible]
    return float(np.quantile(slow if 2 * len(slow) >= len(moving) else moving, 0.95))
