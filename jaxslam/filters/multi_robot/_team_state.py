"""The joint state of a team: the slots of robots and landmarks in a `slots.Joint`.

Robot 0 is the joint's pose, slots 0 … N-1 hold landmarks (x, y, padding), and slot N - 1 + b holds
robot b = 1 … R-1 as a landmark (x, y, θ).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.core.slots import Joint
from jaxslam.filters.multi_robot._team_filter import TeamFilter


class InitialPose(NamedTuple):
    """A candidate pose for the initialization of a robot."""

    pose: Float[Array, "3"]
    rows: Float[Array, "3 D"]
    """covariance of the pose with all errors of the map"""
    cov: Float[Array, "3 3"]
    possible: Bool[Array, ""]


def pose_of(filter: TeamFilter, joint: Joint, robot: int) -> Float[Array, "3"]:
    """The estimate of a robot's pose."""
    return joint.pose if robot == 0 else joint.landmarks[filter.slot_of(robot)]


def robots_in_map(filter: TeamFilter, joint: Joint) -> Bool[Array, "R"]:
    """Mask of the robots that have a pose in the map."""
    return jnp.concatenate([jnp.ones(1, bool), joint.alive[filter.capacity :]])


def with_robot(filter: TeamFilter, joint: Joint, robot: int, new: InitialPose) -> Joint:
    """The joint with a robot b > 0 added in its empty slot."""
    slot, rows = filter.slot_of(robot), filter.rows_of(robot)
    cov = joint.cov.at[rows].set(new.rows).at[:, rows].set(new.rows.T)
    return joint._replace(
        landmarks=joint.landmarks.at[slot].set(new.pose),
        # Last: new.rows are covariances with what was in the map before, zero in these columns.
        cov=cov.at[rows, rows].set(new.cov),
        alive=joint.alive.at[slot].set(True),
        tag=joint.tag.at[slot].set(filter.robot_tags[robot]),
    )


def seen_from(filter: TeamFilter, joint: Joint, robot: int) -> Joint:
    """The joint with robot b as the pose and robot 0 as a landmark in the slot of b."""
    if robot == 0:
        return joint
    slot = filter.slot_of(robot)
    return _exchange(filter, joint, robot)._replace(
        alive=joint.alive.at[slot].set(True),
        tag=joint.tag.at[slot].set(filter.robot_tags[0]),
    )


def seen_from_first(filter: TeamFilter, joint: Joint, robot: int, before: Joint) -> Joint:
    """The inverse of `seen_from`; before: the joint it was applied to, for `alive` and `tag`."""
    if robot == 0:
        return joint
    slot = filter.slot_of(robot)
    return _exchange(filter, joint, robot)._replace(
        alive=joint.alive.at[slot].set(before.alive[slot]),
        tag=joint.tag.at[slot].set(before.tag[slot]),
    )


def _exchange(filter: TeamFilter, joint: Joint, robot: int) -> Joint:
    """The joint with robot 0 and robot b > 0 exchanged; its own inverse except for `alive`."""
    slot, first, second = filter.slot_of(robot), filter.rows_of(0), filter.rows_of(robot)
    cov = joint.cov
    # Whole rows and columns are copied; a gather by index would copy single entries.
    cov = cov.at[first].set(cov[second]).at[second].set(cov[first])
    cov = cov.at[:, first].set(cov[:, second]).at[:, second].set(cov[:, first])
    return joint._replace(
        pose=joint.landmarks[slot], landmarks=joint.landmarks.at[slot].set(joint.pose), cov=cov
    )
