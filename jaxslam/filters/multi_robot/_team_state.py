"""The joint state of a team: the slots of robots and landmarks in a `slots.Joint`; its settings.

Robot 0 is the joint's pose, slots 0 … N-1 hold landmarks (x, y, padding), and slot N - 1 + b holds
robot b = 1 … R-1 as a landmark (x, y, θ).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxslam.core.protocols import Sensor
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.filters.multi_robot._team import Robot

SIZE = 3
"""Numbers of a slot: x, y and the heading of a robot; of a landmark the third is padding."""


@dataclass(frozen=True, eq=False)
class TeamSettings:
    """The robots, the layout of state, control and scan, and the EKF settings of each robot."""

    robots: tuple[Robot, ...]
    capacity: int
    """landmark slots N"""
    tags: tuple[int, ...]
    """(R,) that mean robots"""
    ekfs: tuple[EkfSlam, ...]
    """the EKF-SLAM by which each robot predicts and corrects"""

    @property
    def started(self) -> list[int]:
        """Robots whose pose is known at the start."""
        return [b for b, robot in enumerate(self.robots) if b == 0 or robot.start is not None]

    @property
    def unstarted(self) -> list[int]:
        """Robots whose pose is to be initialized from a scan."""
        return [b for b in range(len(self.robots)) if b not in self.started]

    @property
    def places(self) -> tuple[int, ...]:
        """The number of measurement slots of each robot."""
        return tuple(sum(robot.sensors.places) for robot in self.robots)

    def slot_of(self, robot: int) -> int:
        """The slot of a robot b > 0."""
        return self.capacity - 1 + robot


def check_sensors(robots: Sequence[Robot]) -> None:
    """Raise ValueError unless landmarks are points, and unstarted robots can be initialized."""
    for b, robot in enumerate(robots):
        for part in robot.sensors.parts:
            if part.sensor.landmark and not part.sensor.of_points:
                raise ValueError(
                    f"TeamSlam: expected landmarks (x, y), got {part.sensor.landmark} of "
                    f"{part.sensor.name}"
                )
        able = any(measures_points(part.sensor) for part in robot.sensors.parts)
        if b > 0 and robot.start is None and not able:
            raise ValueError(
                f"TeamSlam: robot {b} needs a start, or a sensor that measures both range and "
                "bearing to find it by"
            )


def measures_points(sensor: Sensor) -> bool:
    """Whether one measurement determines a point (x, y), given the pose."""
    return sensor.of_points and np.shape(sensor.free.mean) == (0,)


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
    return _exchange(joint, robot, settings)._replace(
        alive=joint.alive.at[slot].set(True),
        tag=joint.tag.at[slot].set(settings.tags[0]),
    )


def seen_from_first(joint: Joint, robot: int, before: Joint, settings: TeamSettings) -> Joint:
    """The inverse of `seen_from`; before: the joint it was applied to, for `alive` and `tag`."""
    if robot == 0:
        return joint
    slot = settings.slot_of(robot)
    return _exchange(joint, robot, settings)._replace(
        alive=joint.alive.at[slot].set(before.alive[slot]),
        tag=joint.tag.at[slot].set(before.tag[slot]),
    )


def _exchange(joint: Joint, robot: int, settings: TeamSettings) -> Joint:
    """The joint with robot 0 and another exchanged; its own inverse except for `alive`."""
    slot, first, other = settings.slot_of(robot), slice(0, 3), rows_of(robot, settings)
    cov = joint.cov
    # Whole rows and columns are copied; a gather by index would copy single entries.
    cov = cov.at[first].set(cov[other]).at[other].set(cov[first])
    cov = cov.at[:, first].set(cov[:, other]).at[:, other].set(cov[:, first])
    return joint._replace(
        pose=joint.landmarks[slot], landmarks=joint.landmarks.at[slot].set(joint.pose), cov=cov
    )
