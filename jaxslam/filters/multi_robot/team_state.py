"""The joint state of a team: the slots of robots and landmarks in a `slots.Joint`.

Robot 0 is the joint's pose, slots 0 … N-1 hold landmarks (x, y, padding), and slot N - 1 + b holds
robot b = 1 … R-1 as a landmark (x, y, θ).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.filters.multi_robot.settings import SIZE, TeamSettings
from jaxslam.slots import Joint


class InitialPose(NamedTuple):
    """A candidate pose for the initialization of a robot."""

    pose: Float[Array, "3"]
    rows: Float[Array, "3 D"]
    """its covariance with all errors of the map"""
    cov: Float[Array, "3 3"]
    possible: Bool[Array, ""]


def rows_of(robot: int, settings: TeamSettings) -> slice:
    """The rows of a robot in the covariance."""
    if robot == 0:
        return slice(0, 3)
    slot = settings.slot_of(robot)
    return slice(3 + slot * SIZE, 3 + (slot + 1) * SIZE)


def pose_of(joint: Joint, robot: int, settings: TeamSettings) -> Float[Array, "3"]:
    """The estimate of a robot's pose."""
    return joint.pose if robot == 0 else joint.landmarks[settings.slot_of(robot)]


def robots_in_map(joint: Joint, settings: TeamSettings) -> Bool[Array, "R"]:
    """Which robots have a pose in the map."""
    return jnp.concatenate([jnp.ones(1, bool), joint.alive[settings.capacity :]])


def with_robot(joint: Joint, robot: int, new: InitialPose, settings: TeamSettings) -> Joint:
    """The joint with a robot b > 0 added in its empty slot."""
    slot, rows = settings.slot_of(robot), rows_of(robot, settings)
    cov = joint.cov.at[rows].set(new.rows).at[:, rows].set(new.rows.T)
    return joint._replace(
        landmarks=joint.landmarks.at[slot].set(new.pose),
        cov=cov.at[rows, rows].set(new.cov),
        alive=joint.alive.at[slot].set(True),
        tag=joint.tag.at[slot].set(settings.tags[robot]),
    )


def seen_from(joint: Joint, robot: int, settings: TeamSettings) -> Joint:
    """The joint with robot b as the pose and robot 0 as a landmark in the slot of b."""
    if robot == 0:
        return joint
    slot = settings.slot_of(robot)
    return _exchanged(joint, robot, settings)._replace(
        alive=joint.alive.at[slot].set(True),
        tag=joint.tag.at[slot].set(settings.tags[0]),
    )


def seen_from_first(joint: Joint, robot: int, before: Joint, settings: TeamSettings) -> Joint:
    """The inverse of `seen_from`; before: the joint it was applied to, for `alive` and `tag`."""
    if robot == 0:
        return joint
    slot = settings.slot_of(robot)
    return _exchanged(joint, robot, settings)._replace(
        alive=joint.alive.at[slot].set(before.alive[slot]),
        tag=joint.tag.at[slot].set(before.tag[slot]),
    )


def _exchanged(joint: Joint, robot: int, settings: TeamSettings) -> Joint:
    """The joint with robot 0 and another exchanged; its own inverse except for `alive`."""
    slot, first, other = settings.slot_of(robot), slice(0, 3), rows_of(robot, settings)
    cov = joint.cov
    # Whole rows and columns are copied; a gather by index would copy single entries.
    cov = cov.at[first].set(cov[other]).at[other].set(cov[first])
    cov = cov.at[:, first].set(cov[:, other]).at[:, other].set(cov[:, first])
    return joint._replace(
        pose=joint.landmarks[slot], landmarks=joint.landmarks.at[slot].set(joint.pose), cov=cov
    )
