"""The settings of `TeamSlam`, and their validation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxslam.filters.ekf.settings import EkfSettings
from jaxslam.filters.ekf.steps.scan import SensorTurn
from jaxslam.protocols import Sensor
from jaxslam.team import Robot

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
    ekf: EkfSettings
    """settings of the prediction and the correction of each robot"""
    turns: tuple[list[SensorTurn], ...]
    """turns of the sensors of each robot in a scan"""

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
