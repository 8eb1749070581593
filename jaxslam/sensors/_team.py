"""The robots of a team: their tags, the layout of controls and scans, and models for one robot."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_whole
from jaxslam.core._record import field, record, static
from jaxslam.core._reprs import describe
from jaxslam.core.protocols import Motion, motion_of_pose
from jaxslam.core.validation import InvalidField, covariance, finite, instance_of, or_none
from jaxslam.math._arrays import Control, Pose, ProcessNoise
from jaxslam.sensors._suite import Part, Suite


def _check_start(value: tuple[ArrayLike, ArrayLike]) -> tuple[ArrayLike, ArrayLike]:
    """The check of a pose and its covariance."""
    if not isinstance(value, tuple) or len(value) != 2:
        raise ValueError(f"expected a pose and its covariance, got {describe(value)}")
    return finite(3)(value[0]), covariance(3)(value[1])


@record
class Robot:
    """One robot of a team. Raises ValueError on sensors without a suite, or an invalid start."""

    motion: Motion = field(check=lambda motion: motion_of_pose(instance_of(Motion)(motion)))
    sensors: Suite = field(check=instance_of(Suite))
    """a suite, also of a single sensor"""
    start: tuple[ArrayLike, ArrayLike] | None = field(default=None, check=or_none(_check_start))
    """pose (3,) before the first control in the frame of robot 0, and its covariance (3, 3); None
    if unknown, and of robot 0"""


def team_of_robots(value: Any) -> tuple[Robot, ...]:
    """The check of a field: a sequence of robots, the first without a start."""
    if not isinstance(value, Sequence) or len(value) == 0:
        raise ValueError(f"expected at least one robot, got {describe(value)}")
    robots = tuple(instance_of(Robot)(robot) for robot in value)
    if robots[0].start is not None:
        raise ValueError("expected no start of robot 0: it begins at the pose of the run")
    return robots


def tags_of_robots(robots: int, tags: Sequence[int] | None, landmarks: int) -> tuple[int, ...]:
    """The tags of the robots, by default landmarks, landmarks + 1, …, after the tags of landmarks.

    Raises InvalidField unless they are so many different integers >= 0.
    """
    tags = tuple(range(landmarks, landmarks + robots)) if tags is None else tuple(tags)
    if len(tags) != robots or len(set(tags)) != robots:
        raise InvalidField("tags", f"expected {robots} different ones, of the robots, got {tags}")
    if any(not is_whole(tag) or tag < 0 for tag in tags):
        raise InvalidField("tags", f"expected integers >= 0, of the robots, got {tags}")
    return tags


def sizes(robots: Sequence[Robot]) -> tuple[list[int], list[int], int]:
    """The ends of the robots' parts of the control (ΣU,), the ends of their slots in a scan, and
    the largest Z."""
    controls = np.cumsum([len(robot.motion.controls) for robot in robots]).tolist()
    places = np.cumsum([sum(robot.sensors.places) for robot in robots]).tolist()
    return controls, places, max(len(robot.sensors.measurements) for robot in robots)


@record
class TeamMotion(Motion):
    """The motion of the robot `report`, as a function of the controls (ΣU,) of the whole team."""

    robots: tuple[Motion, ...]
    report: int = static()

    @property
    def controls(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(name for robot in self.robots for name in robot.controls)

    @property
    def noises(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.robots[self.report].noises

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        return self.robots[self.report].step(pose, self._own(u), w)

    def noise_cov(self, pose: Pose, u: Control) -> Array:
        cov: Array = self.robots[self.report].noise_cov(pose, self._own(u))
        return cov

    def _own(self, u: Control) -> Array:
        begin = sum(len(robot.controls) for robot in self.robots[: self.report])
        return u[begin : begin + len(self.robots[self.report].controls)]


def sensors_of(robots: Sequence[Robot], report: int) -> Suite:
    """The sensors of a team as one suite, for a filter of the robot `report` alone.

    The parts of the other robots are marked as parts that see robots, which such a filter ignores.
    """
    parts = []
    for b, robot in enumerate(robots):
        for part in robot.sensors.parts:
            parts.append(part if b == report else Part(part.sensor, part.places, sees="robots"))
    return Suite(tuple(parts))
