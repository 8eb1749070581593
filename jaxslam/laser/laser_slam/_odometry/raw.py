"""Raw odometry: its steps from scan to scan, their covariance, and steps that cannot be right.

Constants without another origin were chosen on the logs intel, edmonton, freiburg-101 and CSAIL.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.laser.laser_slam._records import Settings
from jaxslam.math import numpy_poses as poses
from jaxslam.math._odometry_jumps import odometry_jumps

FARTHEST = (3.0, float(np.deg2rad(100.0)))
"""Largest step [m] and turn [rad] between two scans in a search."""
_SPEED_MARGIN = 1.5
"""Times the usual largest speed, above which a step is faster than the robot can be."""
_USUAL_SHARE = 0.95
"""Quantile of the speeds that is the usual largest speed."""
_BASE_SIGMA = (0.03, 0.02)
"""Standard deviation of a step of raw odometry without motion, [m] and [rad]."""
_SIGMA_SHARES = (0.10, 0.15, 0.05)
"""Standard deviation by motion: position by distance, heading by turn, heading by distance
[rad/m]."""
_MIN_MOVING_STEPS = 20
"""Least number of steps with motion that determine a largest speed."""
_MIN_MOTION = (0.02, 0.02)
"""Least distance [m] and turn [rad] of a step with motion."""
STEP_CHANGE = 0.6
"""Change of an unknown step from the previous step, as a share of the reach."""
_MIN_TIMED_STEP = (0.3, 0.35)
"""[m], [rad]: the timing of shorter steps is too coarse to call them too fast."""
_GAP = 2.5
"""Times the median time between scans above which there is a gap."""


class Steps(NamedTuple):
    """Steps of raw odometry to each of K scans from the previous one, or one of them.

    The first is zero.
    """

    step: Float[np.ndarray, "*K 3"]
    """zero in a jump"""
    cov: Float[np.ndarray, "*K 3 3"]
    """covariance of the end of the step"""
    reach: Float[np.ndarray, "*K 2"]
    """largest distance [m] and turn [rad] of the robot in that time, by its speeds; in an odd step
    `FARTHEST`"""
    jump: Bool[np.ndarray, "*K"]
    """longer than can be, or odometry was set anew"""
    frozen: Bool[np.ndarray, "*K"]
    """no motion, though the scan changed"""
    lags: Bool[np.ndarray, "*K"]
    """too slow, before a step that is too fast and makes up for it: a message came late"""
    gap: Bool[np.ndarray, "*K"]
    """long after the scan before"""
    odd: Bool[np.ndarray, "*K"]
    """faster than the robot can be, though no jump: stamps or raw odometry are wrong"""
    usual_reach: Float[np.ndarray, "*K 2"]
    """`reach` by the speeds alone, in odd steps too"""
    reset: Bool[np.ndarray, "*K"]
    """a jump in which odometry was set anew, while the robot went on as it did"""
    logged: Float[np.ndarray, "*K 3"]
    """step of the log, also in a jump"""

    @property
    def unknown(self) -> Bool[np.ndarray, "*K"]:
        """Mask of the steps without raw odometry."""
        return np.asarray(self.jump | self.frozen)


def steps_of(
    raw: Float[np.ndarray, "K 3"],
    settings: Settings,
    time: Float[np.ndarray, "K"] | None = None,
    changed: Int[np.ndarray, "K"] | Bool[np.ndarray, "K"] | None = None,
    logged_since: Bool[np.ndarray, "K"] | None = None,
) -> Steps:
    """The steps of raw odometry; σ of position and heading grow with distance and turn.

    The largest speed of the robot is the 95 % quantile of the speeds in the log, and 1.5 times it
    is faster than possible.

    | step | by | value | σ added (`reach_cov`) |
    |---|---|---|---|
    | jump | longer than `settings.jump` | 0 | half of the reach |
    | jump, reset | `odometry_jumps`; or frozen and faster than possible | 0 | as frozen |
    | frozen | not logged, or zero while the scans change | as logged | 0.6 of half of the reach |
    | lags | too slow, and the next makes up for it | as logged | half of the reach |
    | any other | | as logged | none |

    The step after a step that lags is right only together with it. A frozen step or a reset is
    assumed to be like the step before.

    Args:
        time: [s] of the scans; None: no speed is known.
        changed: `Scans.changed`, or a mask of the scans that differ from the previous scan; None:
            no scan does.
        logged_since: mask of the scans since whose predecessor odometry was logged; None: all.
    """
    step = np.zeros((len(raw), 3))
    step[1:] = poses.between(np.asarray(raw[:-1], float), np.asarray(raw[1:], float))
    logged = step.copy()
    reset = odometry_jumps(np.asarray(raw, float), time)
    jump = reset | (np.hypot(step[:, 0], step[:, 1]) > settings.jump)
    step[jump] = 0.0
    unlogged = np.zeros(len(raw), bool) if logged_since is None else ~np.asarray(logged_since, bool)
    frozen = unlogged & ~jump
    if changed is not None:
        zero_steps = np.concatenate([[0], np.cumsum(np.all(step == 0, axis=1) & ~jump)])
        back = np.asarray(changed, int)
        for k in np.flatnonzero(back):
            since = k + 1 - back[k]  # the first step after the scan that differs
            if zero_steps[k + 1] - zero_steps[since] == back[k]:
                frozen[since : k + 1] = True
    frozen[0] = False
    duration = np.zeros(len(raw)) if time is None else np.diff(time, prepend=time[:1])
    size = np.stack([np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])], axis=1)
    usual_reach, lags, odd = _judge_speeds(size, duration, jump | frozen)
    reach = np.where(odd[:, None], FARTHEST, usual_reach)
    # A frozen step has no length, unless a reader marked a jump between two messages, of which the
    # step is a part.
    part_of_jump = frozen & (size > usual_reach).any(axis=1)
    reset, jump, frozen = reset | part_of_jump, jump | part_of_jump, frozen & ~part_of_jump
    step[part_of_jump] = size[part_of_jump] = 0.0
    usual = float(np.median(duration[duration > 0])) if (duration > 0).any() else np.inf
    by_far, by_turn, turn_by_far = _SIGMA_SHARES
    position = _BASE_SIGMA[0] + by_far * size[:, 0]
    heading = _BASE_SIGMA[1] + by_turn * size[:, 1] + turn_by_far * size[:, 0]
    cov = np.stack([position, position, heading], axis=1)[:, :, None] ** 2 * np.eye(3)
    cov[0] = 0.0
    anywhere, onward = lags | (jump & ~reset), frozen | reset
    cov[anywhere] += reach_cov(reach[anywhere])
    cov[onward] += reach_cov(STEP_CHANGE * reach[onward])
    gap = duration > _GAP * usual
    return Steps(step, cov, reach, jump, frozen, lags, gap, odd, usual_reach, reset, logged)


def reach_cov(reach: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3 3"]:
    """The covariance of a step with only a known reach: σ is half of the reach."""
    sigma = 0.5 * np.asarray(reach)[..., [0, 0, 1]]
    return np.asarray(sigma[..., None] ** 2 * np.eye(3))


def _judge_speeds(
    size: Float[np.ndarray, "K 2"], duration: Float[np.ndarray, "K"], useless: np.ndarray
) -> tuple[Float[np.ndarray, "K 2"], Bool[np.ndarray, "K"], Bool[np.ndarray, "K"]]:
    """The largest distance and turn of the robot in each step, which steps lag, and which are odd.

    Args:
        size: distance [m] and turn [rad] of each step.
        useless: mask of the steps that say nothing on speeds.
    """
    reach = np.broadcast_to(FARTHEST, size.shape).copy()
    lags = np.zeros(len(size), bool)
    timed = duration > 0
    usable = timed & ~useless
    for column, (least, timed_step) in enumerate(zip(_MIN_MOTION, _MIN_TIMED_STEP, strict=True)):
        way = size[:, column]
        moves = usable & (way > least)
        if moves.sum() < _MIN_MOVING_STEPS:
            continue
        fastest = _SPEED_MARGIN * np.quantile(way[moves] / duration[moves], _USUAL_SHARE)
        farthest = fastest * duration
        reach[timed, column] = np.minimum(FARTHEST[column], farthest[timed])
        # Two steps, the first below half of their mean speed and the second too fast, together of
        # usual speed.
        both, time = way[:-1] + way[1:], duration[:-1] + duration[1:]
        slow = way[:-1] * time < 0.5 * both * duration[:-1]
        fast = (way[1:] > farthest[1:]) & (both <= fastest * time) & (way[1:] > timed_step)
        lags[:-1] |= slow & fast & usable[:-1] & usable[1:]
    # A step that is too fast, and makes up for no step before, has wrong stamps.
    makes_up = np.concatenate([[False], lags[:-1]])
    odd = (size > reach).any(axis=1) & ~makes_up & ~useless
    return reach, lags, odd
