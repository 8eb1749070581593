"""Raw odometry: its steps from scan to scan, their covariance, and steps that cannot be."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.laser_slam.settings import Settings
from jaxslam.math import numpy_poses as poses


class Steps(NamedTuple):
    """The steps of raw odometry to each scan from the one before; the first is none."""

    step: Float[np.ndarray, "K 3"]
    cov: Float[np.ndarray, "K 3 3"]
    """of the end of the step"""
    jump: Bool[np.ndarray, "K"]
    """longer than can be: the step is zero, and its covariance wide"""


WIDE = (1.0, 1.0, 1.0)
"""Standard deviations [m, m, rad] of a step that raw odometry does not tell."""


def steps_of(raw: Float[np.ndarray, "K 3"], settings: Settings) -> Steps:
    """The steps of raw odometry; σ of position and heading grow with distance and turn."""
    step = np.zeros((len(raw), 3))
    step[1:] = poses.between(np.asarray(raw[:-1], float), np.asarray(raw[1:], float))
    far = np.hypot(step[:, 0], step[:, 1])
    jump = far > settings.jump
    step[jump] = 0.0
    far = np.where(jump, 0.0, far)
    by_far, by_turn, turn_by_far = settings.odometry_share
    position = settings.odometry_base[0] + by_far * far
    heading = settings.odometry_base[1] + by_turn * np.abs(step[:, 2]) + turn_by_far * far
    sigma = np.stack([position, position, heading], axis=1)
    sigma[jump] = WIDE
    cov = sigma[:, :, None] ** 2 * np.eye(3)
    cov[0] = 0.0
    return Steps(step, cov, jump)
