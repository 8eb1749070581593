"""The true path of an MRCLAM robot at the rows of a log."""

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.logs.streams import interpolate_poses

GAP = 0.2
"""Time between lines of the truth beyond which it is unknown between them [s]."""
START_COV = np.diag([0.01, 0.01, 0.03]) ** 2
"""Covariance of a true pose. Of robot 1 of data set 6, headings that two landmarks give agree with
the recorded ones to 0.03 rad, with errors that last for tens of seconds."""


def cut_after(
    odometry: Float[np.ndarray, "K 3"], end: float
) -> tuple[Float[np.ndarray, "J 3"], int]:
    """Odometry without the (0, 0) lines at its end that are later than `end`, and their number.

    A recorder that goes on after the robot has stopped writes such lines. The first of them stays,
    so that the robot stands still from there on.
    """
    moving = np.flatnonzero(odometry[:, 1:].any(axis=1) | (odometry[:, 0] <= end))
    keep = min(int(moving[-1]) + 2 if moving.size else 1, len(odometry))
    return odometry[:keep], len(odometry) - keep


def true_poses(
    truth: Float[np.ndarray, "K 4"], time: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, "T"]]:
    """True poses at some times, linear between lines of the truth, and where they are known.

    They are unknown before the first line, after the last, and between lines more than `GAP` apart.
    """
    clock = truth[:, 0]
    after = np.clip(np.searchsorted(clock, time), 1, max(len(clock) - 1, 1))
    last = np.minimum(after, len(clock) - 1)
    near = clock[last] - clock[after - 1] <= GAP
    known = (time >= clock[0]) & (time <= clock[-1]) & (near | np.isin(time, clock))
    return interpolate_poses(clock, truth[:, 1:], time), known
