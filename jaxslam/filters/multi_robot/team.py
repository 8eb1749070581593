"""The robots of a team, and their poses in its state.

`filters.TeamSlam` is their filter, and `TeamWorld` simulates their worlds.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jaxslam.core._numbers import check_covariance, is_concrete
from jaxslam.core._record import record
from jaxslam.core.protocols import Motion
from jaxslam.core.slots import Joint
from jaxslam.sensors._suite import Suite

__all__ = ["Robot", "pose_cross_cov", "poses"]


@record
class Robot:
    """One robot of a team. Raises ValueError on sensors without a suite, or an invalid start."""

    motion: Motion
    sensors: Suite
    """a suite, also of a single sensor"""
    start: tuple[ArrayLike, ArrayLike] | None = None
    """pose (3,) before the first control in the frame of robot 0, and its covariance (3, 3); None
    if unknown, and of robot 0"""

    def __post_init__(self) -> None:
        if not isinstance(self.motion, Motion) or not isinstance(self.sensors, Suite):
            got = f"{type(self.motion).__name__} and {type(self.sensors).__name__}"
            raise ValueError(f"Robot: expected a motion and a Suite, got {got}")
        if self.start is not None:
            if np.shape(self.start[0]) != (3,):
                raise ValueError(
                    f"Robot: expected a start of shape (3,), got {np.shape(self.start[0])}"
                )
            if is_concrete(self.start[0]) and not np.all(np.isfinite(np.asarray(self.start[0]))):
                raise ValueError("Robot: the start is not finite")
            check_covariance("Robot: covariance of the start", self.start[1], 3)


def poses(
    joint: Joint, robots: int
) -> tuple[Float[Array, "R 3"], Float[Array, "R 3 3"], Bool[Array, "R"]]:
    """The poses of the robots in a state of `filters.TeamSlam`, their covariances, and the mask of
    the robots in the map.

    As a probe, for all steps of a run: `run(filter, …, probe=partial(poses, robots=3))`. A robot
    that is not in the map has zeros and unit covariance.
    """
    first = joint.alive.shape[0] - robots + 1
    b = np.arange(robots)
    return (
        jnp.concatenate([joint.pose[None], joint.landmarks[first:]]),
        pose_cross_cov(joint, robots)[b, :, b],
        jnp.concatenate([jnp.ones(1, bool), joint.alive[first:]]),
    )


def pose_cross_cov(joint: Joint, robots: int) -> Float[Array, "R 3 R 3"]:
    """The covariances of the poses of all robots with each other."""
    first = 3 + 3 * (joint.alive.shape[0] - robots + 1)
    at = np.concatenate([np.arange(3), first + np.arange(3 * (robots - 1))])
    return joint.cov[at][:, at].reshape(robots, 3, robots, 3)
