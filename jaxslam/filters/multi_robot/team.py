"""The robots of a team, and their poses in its state.

`filters.TeamSlam` is their filter, and `TeamWorld` simulates their worlds.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam._public import publish
from jaxslam.core.slots import Joint
from jaxslam.sensors._team import Robot

__all__ = ["Robot", "pose_cross_cov", "poses"]


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


publish(__name__)
