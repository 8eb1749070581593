"""Several robots: what each of them is, and worlds in which they move and see each other."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.math.linalg import check_covariance, is_concrete
from jaxslam.protocols import Motion
from jaxslam.sensors.suite import Part, Suite, suite
from jaxslam.simulation.worlds import Scenario, drawn_near, drive, part_scan, side_by_side
from jaxslam.slots import Joint
from jaxslam.types import Log, Scan, Truth


@dataclass(frozen=True, eq=False)
class Robot:
    """One robot of a team. Raises ValueError on sensors that are no suite, or a bad start."""

    motion: Motion
    sensors: Suite
    """made by `sensors.suite`, also of a single one"""
    start: tuple[ArrayLike, ArrayLike] | None = None
    """pose (3,) before the first control in the frame of robot 0's, and its covariance (3, 3); None
    where unknown, and of robot 0"""

    def __post_init__(self) -> None:
        if not isinstance(self.motion, Motion) or not isinstance(self.sensors, Suite):
            raise ValueError(
                f"Robot: expected a motion and a sensors.suite, got {self.motion!r} and "
                f"{self.sensors!r}"
            )
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
    """The tags that mean robots; ValueError unless this is a team.

    Default landmarks, landmarks + 1, …: the numbers after those of the landmarks' tags.
    """
    if not isinstance(robots, Sequence) or len(robots) == 0:
        raise ValueError(f"{name}: expected at least one robot, got {robots!r}")
    for robot in robots:
        if not isinstance(robot, Robot):
            raise ValueError(f"{name}: expected a team.Robot, got {robot!r}")
    if robots[0].start is not None:
        raise ValueError(f"{name}: robot 0 has no start of its own, the run's is its start")
    made = tuple(range(landmarks, landmarks + len(robots))) if tags is None else tuple(tags)
    if len(made) != len(robots) or len(set(made)) != len(made):
        raise ValueError(f"{name}: expected {len(robots)} different tags of robots, got {made}")
    if any(type(tag) is not int or tag < 0 for tag in made):
        raise ValueError(f"{name}: expected tags of robots that are integers >= 0, got {made}")
    return made


def sizes(robots: Sequence[Robot]) -> tuple[list[int], list[int], int]:
    """Where each robot's part of the control and of a scan's places ends; the largest Z."""
    controls = np.cumsum([len(robot.motion.controls) for robot in robots]).tolist()
    places = np.cumsum([sum(robot.sensors.places) for robot in robots]).tolist()
    return controls, places, max(len(robot.sensors.measurements) for robot in robots)


def poses(joint: Joint, robots: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of a state of `filters.team_slam` for so many robots: their poses (R, 3), the covariance of
    each (R, 3, 3), and whether it is in the map (R,).

    As a probe, of a whole run: `run(filter, …, probe=partial(poses, robots=3))`. A robot that is
    not in the map has zeros and unit covariance.
    """
    first = joint.alive.shape[0] - robots + 1
    every = np.arange(robots)
    return (
        jnp.concatenate([joint.pose[None], joint.landmarks[first:]]),
        pose_cross_cov(joint, robots)[every, :, every],
        jnp.concatenate([jnp.ones(1, bool), joint.alive[first:]]),
    )


def pose_cross_cov(joint: Joint, robots: int) -> jax.Array:
    """(R, 3, R, 3): covariances of the poses of all robots with each other."""
    first = 3 + 3 * (joint.alive.shape[0] - robots + 1)
    at = np.concatenate([np.arange(3), first + np.arange(3 * (robots - 1))])
    return joint.cov[at][:, at].reshape(robots, 3, robots, 3)


def world(
    robots: Sequence[Robot],
    landmarks: ArrayLike,
    controls: ArrayLike,
    *,
    tags: Sequence[int] | None = None,
    report: int = 0,
    name: str = "team",
    pose: ArrayLike = (0.0, 0.0, 0.0),
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    **options: Any,
) -> Scenario:
    """A scenario of several robots among landmarks (x, y), for `simulate` and `monte_carlo`.

    A part of a suite that sees "robots" gets the positions of the other robots as landmarks, with
    their tags, in its places. Every robot needs a start, which the truth is drawn around; a filter
    for which it is unknown is made from `dataclasses.replace(robot, start=None)`.

    The truth is that of one robot, so campaigns judge the filter whose `report` is the same; the
    draws are the same whatever is reported. Divergence limit and bound of a campaign are those of
    that robot alone, started as robot 0 is.

    Args:
        robots: R of them.
        landmarks: (N, 2).
        controls: (T, ΣU), those of robot 0 first.
        tags: (R,) of the robots; default N, N + 1, …
        report: which robot the truth is of.
        pose, pose_cov: what is known of robot 0 before the first control.
        options: other fields of `Scenario`: visible, published, source.
    Raises:
        ValueError: on no robots, tags that clash, a robot without start, one that is not there to
            report, and as `Scenario` does.
    """
    count = int(np.shape(landmarks)[0]) if np.ndim(landmarks) == 2 else 0
    own_tags = check_team("team.world", robots, tags, count)
    clash = [tag for tag in own_tags if tag < count]
    if clash:
        raise ValueError(f"team.world: the tag {clash[0]} is a landmark's")
    if any(robot.start is None for robot in robots[1:]):
        raise ValueError("team.world: every robot but robot 0 needs a start")
    if type(report) is not int or not 0 <= report < len(robots):
        raise ValueError(f"team.world: there is no robot {report!r} to report")
    for what in ("places", "spurious", "noise_on", "draw"):
        if what in options:
            raise ValueError(f"team.world: does not take {what}")
    return Scenario(
        name=name,
        motion=motion_of(robots, report),
        sensor=sensors_of(robots, report),
        landmarks=landmarks,
        controls=controls,
        pose=pose,
        pose_cov=pose_cov,
        draw=partial(_draw, robots=tuple(robots), tags=own_tags, report=report),
        **options,
    )


def histories(scenario: Scenario, robots: Sequence[Robot], key: jax.Array) -> tuple[Any, Any, Any]:
    """Of all robots, as a `world` draws them: starts (R, 3), true poses (R, T, 3), controls."""
    dtype = jnp.result_type(float)
    key_motion, _, key_start = jax.random.split(key, 3)
    controls = jnp.asarray(scenario.controls, dtype)
    first = drawn_near(jnp.asarray(scenario.pose, dtype), scenario.pose_cov, key_start)
    ends, _, _ = sizes(robots)
    starts, poses, logged = [], [], []
    for b, robot in enumerate(robots):
        own_key = jax.random.fold_in(key_start, b)
        start = first
        if robot.start is not None:
            mean, cov = robot.start
            start = se2.compose(first, drawn_near(jnp.asarray(mean, dtype), cov, own_key))
        own = controls[:, ends[b] - len(robot.motion.controls) : ends[b]]
        path, log = drive(robot.motion, start, own, jax.random.fold_in(key_motion, b))
        starts.append(start)
        poses.append(path)
        logged.append(log)
    return jnp.stack(starts), jnp.stack(poses), jnp.concatenate(logged, axis=1)


def _draw(
    scenario: Scenario,
    key: jax.Array,
    *,
    robots: tuple[Robot, ...],
    tags: tuple[int, ...],
    report: int,
) -> tuple[Truth, Log]:
    starts, poses, controls = histories(scenario, robots, key)
    landmarks = jnp.asarray(scenario.landmarks, poses.dtype)
    _, key_scan, _ = jax.random.split(key, 3)
    scans: list[tuple[Scan, jax.Array]] = []
    missed = []
    for b, robot in enumerate(robots):
        others = [a for a in range(len(robots)) if a != b]
        targets = {
            "landmarks": (landmarks, jnp.arange(landmarks.shape[0])),
            "robots": (
                jnp.stack([poses[a][:, :2] for a in others], axis=1) if others else landmarks[:0],
                jnp.asarray([tags[a] for a in others], jnp.int32),
            ),
        }
        for i, part in enumerate(robot.sensors.parts):
            part_key = jax.random.fold_in(jax.random.fold_in(key_scan, b), i)
            field = scenario.visible
            scans.append(part_scan(part, field, poses[b], *targets[part.sees], part_key))
            if b == report:
                missed.append(scans[-1][1])
    scan, _ = side_by_side(scans, sizes(robots)[2])
    mine = jnp.stack(missed).sum(axis=0)
    return Truth(poses[report], landmarks, mine, starts[report]), Log(controls, scan)


def motion_of(robots: Sequence[Robot], report: int) -> Motion:
    """The motion of one robot, by its part of the whole control."""
    ends, _, _ = sizes(robots)
    own = robots[report].motion
    at = slice(ends[report] - len(own.controls), ends[report])
    return Motion(
        name="team",
        controls=tuple(name for robot in robots for name in robot.motion.controls),
        noises=own.noises,
        step=lambda pose, u, w: own.step(pose, u[at], w),
        noise_cov=lambda pose, u: own.noise_cov(pose, u[at]),
    )


def sensors_of(robots: Sequence[Robot], report: int) -> Suite:
    """All sensors; what others measure is set aside, as `ekf_slam` does with sighted robots."""
    parts = []
    for b, robot in enumerate(robots):
        for part in robot.sensors.parts:
            parts.append(part if b == report else Part(part.sensor, part.places, sees="robots"))
    return suite(*parts)
