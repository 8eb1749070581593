"""Worlds of several robots that move among landmarks and see each other."""

from collections.abc import Mapping
from dataclasses import KW_ONLY

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxslam._public import publish
from jaxslam.core._record import FrozenDict, field, function_of, record, set_field, static
from jaxslam.core.protocols import POSE, Motion, Sensor
from jaxslam.core.types import Log, Scan, Truth
from jaxslam.core.validation import InvalidField
from jaxslam.math import se2
from jaxslam.sensors._team import (
    Robot,
    TeamMotion,
    sensors_of,
    sizes,
    tags_of_robots,
    team_of_robots,
)
from jaxslam.simulation._scans import Visible, everywhere, part_scan, side_by_side
from jaxslam.simulation._worlds import World, drive, random_pose


@record
class TeamWorld(World):
    """A world of several robots among landmarks (x, y), for `simulate` and `monte_carlo`.

    A part of a suite that sees "robots" gets the positions of the other robots as landmarks, with
    their tags, in its places. Every robot needs a start, which the truth is drawn around; a filter
    for which it is unknown is made from `dataclasses.replace(robot, start=None)`.

    The truth is one robot's, so campaigns judge the filter whose `report` is the same; the draws
    are the same for any report. Divergence limit and bound of a campaign are computed for that
    robot alone, started as robot 0 is.

    Raises ValueError on no robots, tags that clash, a robot without start, one that is not there to
    report, and as `Scenario` does.
    """

    robots: tuple[Robot, ...] = field(check=team_of_robots)
    """R robots, in a list or tuple"""
    landmarks: ArrayLike = field()
    """(N, 2)"""
    controls: ArrayLike = field()
    """(T, ΣU) of all robots, robot 0 first"""
    _: KW_ONLY
    tags: tuple[int, ...] | None = static(default=None)
    """(R,) of the robots; default N, N + 1, …"""
    report: int = static(default=0)
    """the robot of the truth"""
    name: str = static(default="team")
    pose: ArrayLike = (0.0, 0.0, 0.0)
    """(3,) mean of the prior of robot 0 before the first control, and"""
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """(3, 3) its covariance"""
    visible: Visible = field(default=everywhere, check=function_of("pose", "l"))
    published: Mapping[str, Mapping[str, float]] = static(default=FrozenDict())
    source: str = static(default="")
    """see `Scenario` for these three fields"""

    def __post_init__(self) -> None:
        count = int(np.shape(self.landmarks)[0]) if np.ndim(self.landmarks) == 2 else 0
        tags = tags_of_robots(len(self.robots), self.tags, count)
        set_field(self, "tags", tags)
        clash = [tag for tag in tags if tag < count]
        if clash:
            raise InvalidField(
                "", f"expected tags of robots from {count} on, after the landmarks', got {clash[0]}"
            )
        if any(robot.start is None for robot in self.robots[1:]):
            raise InvalidField("", "expected a start of every robot but robot 0")
        if type(self.report) is not int or not 0 <= self.report < len(self.robots):
            raise InvalidField(
                "report", f"expected a number from 0 to {len(self.robots) - 1}, got {self.report!r}"
            )
        super().__post_init__()

    @property
    def motion(self) -> Motion:  # type: ignore[override]
        return TeamMotion(tuple(robot.motion for robot in self.robots), self.report)

    @property
    def sensor(self) -> Sensor:  # type: ignore[override]
        return sensors_of(self.robots, self.report)

    def histories(
        self, key: Array
    ) -> tuple[Float[Array, "R 3"], Float[Array, "R T 3"], Float[Array, "T ΣU"]]:
        """The starts, true paths and logged controls of all robots."""
        dtype = jnp.result_type(float)
        key_motion, _, key_start = jax.random.split(key, 3)
        controls = jnp.asarray(self.controls, dtype)
        first = random_pose(jnp.asarray(self.pose, dtype), self.pose_cov, key_start)
        ends, _, _ = sizes(self.robots)
        starts, poses, logged = [], [], []
        for b, robot in enumerate(self.robots):
            own_key = jax.random.fold_in(key_start, b)
            start = first
            if robot.start is not None:
                mean, cov = robot.start
                start = se2.compose(first, random_pose(jnp.asarray(mean, dtype), cov, own_key))
            robot_controls = controls[:, ends[b] - len(robot.motion.controls) : ends[b]]
            path, log = drive(
                robot.motion, start, robot_controls, jax.random.fold_in(key_motion, b)
            )
            starts.append(start)
            poses.append(path)
            logged.append(log)
        return jnp.stack(starts), jnp.stack(poses), jnp.concatenate(logged, axis=1)

    def draw(self, key: Array) -> tuple[Truth, Log]:
        robots, tags = self.robots, self.tags or ()
        starts, poses, controls = self.histories(key)
        landmarks = jnp.asarray(self.landmarks, poses.dtype)
        _, key_scan, _ = jax.random.split(key, 3)
        scans: list[tuple[Scan, Array]] = []
        missed = []
        for b, robot in enumerate(robots):
            others = [a for a in range(len(robots)) if a != b]
            seen = [poses[a][:, :2] for a in others]
            targets = {
                "landmarks": (landmarks, jnp.arange(landmarks.shape[0])),
                "robots": (
                    jnp.stack(seen, axis=1) if others else landmarks[:0],
                    jnp.asarray([tags[a] for a in others], jnp.int32),
                ),
            }
            for i, part in enumerate(robot.sensors.parts):
                part_key = jax.random.fold_in(jax.random.fold_in(key_scan, b), i)
                field = self.visible
                seen_at = poses[b], *targets[part.sees]
                scans.append(part_scan(part, POSE, field, *seen_at, part_key))
                if b == self.report:
                    missed.append(scans[-1][1])
        scan, _ = side_by_side(scans, sizes(robots)[2])
        missed_by_robot = jnp.stack(missed).sum(axis=0)
        truth = Truth(poses[self.report], landmarks, missed_by_robot, starts[self.report])
        return truth, Log(controls, scan)


publish("jaxslam", TeamWorld)
