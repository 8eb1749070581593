"""The robots of a team, and the layout of their controls, scans and states.

`filters.TeamSlam` is their filter, and `TeamWorld` simulates their worlds.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jaxslam.core._numbers import check_covariance, is_concrete
from jaxslam.core._record import record, static
from jaxslam.core.protocols import Motion
from jaxslam.core.slots import Joint
from jaxslam.math._arrays import Control, Pose, ProcessNoise
from jaxslam.sensors._suite import Part, Suite

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


def check_team(
    name: str, robots: Sequence[Robot], tags: Sequence[int] | None, landmarks: int
) -> tuple[int, ...]:
    """The tags of the robots, by default landmarks, landmarks + 1, …, after the tags of landmarks.

    Raises ValueError, which begins with the caller's name, unless this is a team.
    """
    if not isinstance(robots, Sequence) or len(robots) == 0:
        raise ValueError(f"{name}: expected at least one robot, got {robots!r}")
    for robot in robots:
        if not isinstance(robot, Robot):
            raise ValueError(f"{name}: expected a team.Robot, got {type(robot).__name__}")
    if robots[0].start is not None:
        raise ValueError(f"{name}: expected no start of robot 0: it begins at the pose of the run")
    count = len(robots)
    tags = tuple(range(landmarks, landmarks + count)) if tags is None else tuple(tags)
    if len(tags) != count or len(set(tags)) != count:
        raise ValueError(f"{name}: expected {count} different tags of robots, got {tags}")
    if any(type(tag) is not int or tag < 0 for tag in tags):
        raise ValueError(f"{name}: expected tags of robots that are integers >= 0, got {tags}")
    return tags


def sizes(robots: Sequence[Robot]) -> tuple[list[int], list[int], int]:
    """The ends of the robots' parts of the control (ΣU,), the ends of their slots in a scan, and
    the largest Z."""
    controls = np.cumsum([len(robot.motion.controls) for robot in robots]).tolist()
    places = np.cumsum([sum(robot.sensors.places) for robot in robots]).tolist()
    return controls, places, max(len(robot.sensors.measurements) for robot in robots)


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
