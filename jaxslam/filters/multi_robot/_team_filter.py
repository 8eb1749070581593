"""The robots and options of `TeamSlam`, which its steps take, and the layout of its state."""

import dataclasses
from collections.abc import Sequence
from typing import get_args

import numpy as np

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core._record import field, function_of, record, set_field, static
from jaxslam.core._validation import check_models
from jaxslam.core.protocols import Associate, Filter, Sensor
from jaxslam.core.validation import InvalidField, at_least, one_of, or_none, probability
from jaxslam.filters._ekf.correction import CorrectionOrder, Covariance
from jaxslam.filters.multi_robot.team import Robot
from jaxslam.math._arrays import Number
from jaxslam.sensors._team import sizes, tags_of_robots, team_of_robots

SIZE = 3
"""Numbers of a slot: x, y and the heading of a robot; of a landmark the third is padding."""


@record
class TeamFilter(Filter):
    """The robots and options of `TeamSlam`, and what follows from them."""

    robots: tuple[Robot, ...] = field(check=team_of_robots)
    """`team.Robot`s, in a list or tuple; robot 0 starts where the run does, the others relative to
    it"""
    capacity: int = static(check=at_least(1))
    """landmark slots N"""
    _: dataclasses.KW_ONLY
    tags: tuple[int, ...] | None = static(default=None)
    """R tags that mean robots; default N, N + 1, …"""
    report: int = static(default=0)
    """the robot of `estimate`; `team.poses` has all"""
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """See `EkfSlam.associate`."""
    correction: CorrectionOrder = static(
        default="sequential", check=one_of(*get_args(CorrectionOrder))
    )
    """See `EkfSlam.correction`."""
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`."""
    iterations: int = static(default=1, check=at_least(1))
    """See `EkfSlam.iterations`."""
    covariance: Covariance = static(default="plain", check=one_of("plain", "joseph"))
    """"plain" or "joseph"; see `EkfSlam.covariance`."""
    births: int | None = static(default=None, check=or_none(at_least(1)))
    """See `EkfSlam.births`; a limit for each sensor."""
    chart = Euclidean()

    def __post_init__(self) -> None:
        robots = self.robots
        tags = tags_of_robots(len(robots), self.tags, self.capacity)
        if self.tags is not None:
            set_field(self, "tags", tags)
        for robot in robots:
            check_models(robot.motion, robot.sensors)
        if type(self.report) is not int or not 0 <= self.report < len(robots):
            raise InvalidField(
                "report", f"expected a number from 0 to {len(robots) - 1}, got {self.report!r}"
            )
        _check_sensors(robots)
        super().__post_init__()

    @property
    def controls(self) -> tuple[str, ...]:
        return tuple(name for robot in self.robots for name in robot.motion.controls)

    @property
    def measurements(self) -> tuple[str, ...]:
        return tuple(f"entry {i} of its sensor" for i in range(sizes(self.robots)[2]))

    @property
    def places(self) -> tuple[int, ...]:
        return tuple(places for robot in self.robots for places in robot.sensors.places)

    @property
    def places_by_robot(self) -> tuple[int, ...]:
        """The number of measurement slots of each robot."""
        return tuple(sum(robot.sensors.places) for robot in self.robots)

    @property
    def robot_tags(self) -> tuple[int, ...]:
        """The tags (R,) that mean robots: `tags`, or their default."""
        return self.tags or tuple(range(self.capacity, self.capacity + len(self.robots)))

    @property
    def started(self) -> list[int]:
        """Robots whose pose is known at the start."""
        return [b for b, robot in enumerate(self.robots) if b == 0 or robot.start is not None]

    @property
    def unstarted(self) -> list[int]:
        """Robots whose pose is to be initialized from a scan."""
        return [b for b in range(len(self.robots)) if b not in self.started]

    def slot_of(self, robot: int) -> int:
        """The slot of a robot b > 0."""
        return self.capacity - 1 + robot

    def rows_of(self, robot: int) -> slice:
        """The rows of a robot in the covariance."""
        if robot == 0:
            return slice(0, 3)
        slot = self.slot_of(robot)
        return slice(3 + slot * SIZE, 3 + (slot + 1) * SIZE)


def _check_sensors(robots: Sequence[Robot]) -> None:
    """Raise InvalidField unless landmarks are points, and unstarted robots can be initialized."""
    for b, robot in enumerate(robots):
        for part in robot.sensors.parts:
            if part.sensor.landmark and not part.sensor.of_points:
                got = f"{part.sensor.landmark} of {part.sensor.name}"
                raise InvalidField(f"robots[{b}]", f"expected landmarks (x, y), got {got}")
        able = any(measures_points(part.sensor) for part in robot.sensors.parts)
        if b > 0 and robot.start is None and not able:
            raise InvalidField(
                f"robots[{b}]",
                "expected a start, or a sensor that measures both range and bearing to find it by",
            )


def measures_points(sensor: Sensor) -> bool:
    """True if one measurement determines a point (x, y), for a known pose."""
    return sensor.of_points and np.shape(sensor.free.mean) == (0,)
