"""Raw odometry: its steps from scan to scan, their covariance, and steps that cannot be right."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.laser.laser_slam._records import Settings
from jaxslam.math import numpy_poses as poses
from jaxslam.math._odometry_jumps import odometry_jumps

FARTHEST = (3.0, float(np.deg2rad(100.0)))
"""Largest step [m] and turn [rad] between two scans in a search."""
_SPEED_MARGIN = 1.5
"""Factor on the usual largest speed that the robot cannot exceed"""
_BASE_SIGMA = (0.03, 0.02)
"""Standard deviation of a step of raw odometry, [m] and [rad]"""
_SIGMA_SHARES = (0.10, 0.15, 0.05)
"""and more of it: position by distance, heading by turn, heading by distance [rad/m]."""
_MIN_MOVING_STEPS = 20
"""Steps with motion that determine a largest speed"""
_MIN_MOTION = (0.02, 0.02)
"""Least motion of such a step, [m] and [rad]"""
STEP_CHANGE = 0.6
"""Change of an unknown step from the previous step, as a share of the reach"""
_MIN_TIMED_STEP = (0.3, 0.35)
"""[m], [rad]: the timing of shorter steps is too coarse to call them too fast"""


class Steps(NamedTuple):
    """Steps of raw odometry to each of K scans from the previous one, or one of them.

    The first is zero.
    """

    step: Float[np.ndarray, "*K 3"]
    cov: Float[np.ndarray, "*K 3 3"]
    """of the end of the step"""
    reach: Float[np.ndarray, "*K 2"]
    """how far the robot can have gone in that time [m], and turned [rad], by its speeds"""
    jump: Bool[np.ndarray, "*K"]
    """longer than can be, or no motion: the step is zero"""
    frozen: Bool[np.ndarray, "*K"]
    """none, though the scan changed"""
    lags: Bool[np.ndarray, "*K"]
    """slow, before one that is faster than can be and makes up for it: a message came late"""
    gap: Bool[np.ndarray, "*K"]
    """long after the scan before"""
    odd: Bool[np.ndarray, "*K"]
    """faster than the robot can be, though no jump: stamps or raw odometry are wrong"""
    usual_reach: Float[np.ndarray, "*K 2"]
    """`reach` without that of odd steps, which is all that is searched"""
    reset: Bool[np.ndarray, "*K"]
    """a jump in which odometry was set anew, while the robot went on as it did"""
    logged: Float[np.ndarray, "*K 3"]
    """the steps of the log, also where these are jumps"""

    @property
    def unknown(self) -> Bool[np.ndarray, "*K"]:
        """Mask of the steps without raw odometry."""
        return np.asarray(self.jump | self.frozen)


def steps_of(
    raw: Float[np.ndarray, "K 3"],
    settings: Settings,
    time: Float[np.ndarray, "K"] | None = None,
    changed: Int[np.ndarray, "K"] | Bool[np.ndarray, "K"] | None = None,
    known: Bool[np.ndarray, "K"] | None = None,
) -> Steps:
    """The steps of raw odometry; σ of position and heading grow with distance and turn.

    The largest speed of the robot is the 95 % quantile of the speeds in the log, and 1.5 times it
    is faster than possible. A step that is a jump, or lags, has σ of half of what the robot can
    have gone in that time, since raw odometry may err by all of it; one that is frozen 0.6 of that,
    about a step like the one before. The step after one that lags is right only together with it.
    Jumps are the steps longer than `settings.jump`, and those in which odometry was set anew, which
    are like frozen ones: by `odometry_jumps`, and steps both unknown and faster than possible.

    Args:
        time: [s] of the scans; None: no speed is known.
        changed: as `Scans.changed`, or whether each scan differs from the previous one; None: none
            does.
        known: whether odometry was logged since the scan before; None: always.
    """
    step = np.zeros((len(raw), 3))
    step[1:] = poses.between(np.asarray(raw[:-1], float), np.asarray(raw[1:], float))
    logged = step.copy()
    reset = odometry_jumps(np.asarray(raw, float), time)
    jump = reset | (np.hypot(step[:, 0], step[:, 1]) > settings.jump)
    step[jump] = 0.0
    unknown = np.zeros(len(raw), bool) if known is None else ~np.asarray(known, bool)
    frozen = unknown & ~jump
    if changed is not None:
        still = np.concatenate([[0], np.cumsum(np.all(step == 0, axis=1) & ~jump)])
        back = np.asarray(changed, int)
        for k in np.flatnonzero(back):
            if still[k + 1] - still[k + 1 - back[k]] == back[k]:  # all steps since that scan
                frozen[k + 1 - back[k] : k + 1] = True
    frozen[0] = False
    duration = np.zeros(len(raw)) if time is None else np.diff(time, prepend=time[:1])
    size = np.stack([np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])], axis=1)
    usual_reach, lags, odd = _by_speeds(size, duration, jump | frozen)
    reach = np.where(odd[:, None], FARTHEST, usual_reach)
    # A reader has found a jump between two messages, of which this step is a part.
    part = frozen & (size > usual_reach).any(axis=1)
    reset, jump, frozen = reset | part, jump | part, frozen & ~part
    step[part] = size[part] = 0.0
    usual = float(np.median(duration[duration > 0])) if (duration > 0).any() else np.inf
    by_far, by_turn, turn_by_far = _SIGMA_SHARES
    position = _BASE_SIGMA[0] + by_far * size[:, 0]
    heading = _BASE_SIGMA[1] + by_turn * size[:, 1] + turn_by_far * size[:, 0]
    cov = np.stack([position, position, heading], axis=1)[:, :, None] ** 2 * np.eye(3)
    cov[0] = 0.0
    anywhere, onward = lags | (jump & ~reset), frozen | reset
    cov[anywhere] += reach_cov(reach[anywhere])
    cov[onward] += reach_cov(STEP_CHANGE * reach[onward])
    gap = duration > 2.5 * usual
    return Steps(step, cov, reach, jump, frozen, lags, gap, odd, usual_reach, reset, logged)


def reach_cov(reach: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3 3"]:
    """The covariance of a step with only a known reach: σ is half of the reach."""
    sigma = 0.5 * np.asarray(reach)[..., [0, 0, 1]]
    return np.asarray(sigma[..., None] ** 2 * np.eye(3))


def _by_speeds(
    size: Float[np.ndarray, "K 2"], duration: Float[np.ndarray, "K"], useless: np.ndarray
) -> tuple[Float[np.ndarray, "K 2"], Bool[np.ndarray, "K"], Bool[np.ndarray, "K"]]:
    """How far the robot can have gone at each step, which steps lag, and which are odd."""
    reach = np.broadcast_to(FARTHEST, size.shape).copy()
    lags = np.zeros(len(size), bool)
    timed = duration > 0
    for column, (least, much) in enumerate(zip(_MIN_MOTION, _MIN_TIMED_STEP, strict=True)):
        way = size[:, column]
        moves = timed & ~useless & (way > least)
        if moves.sum() < _MIN_MOVING_STEPS:
            continue
        fastest = _SPEED_MARGIN * np.quantile(way[moves] / duration[moves], 0.95)
        can = fastest * duration
        reach[timed, column] = np.minimum(FARTHEST[column], can[timed])
        # Two steps, the first too slow and the second too fast, together of usual speed.
        both, time = way[:-1] + way[1:], duration[:-1] + duration[1:]
        slow = way[:-1] * time < 0.5 * both * duration[:-1]
        fast = (way[1:] > can[1:]) & (both <= fastest * time) & (way[1:] > much)
        lags[:-1] |= slow & fast & (timed & ~useless)[:-1] & (timed & ~useless)[1:]
    # A step that is faster than can be, and makes up for no other, has wrong stamps.
    made_up = np.concatenate([[False], lags[:-1]])
    odd = (size > reach).any(axis=1) & ~made_up & ~useless
    return reach, lags, odd
