"""Worlds of several robots that move among landmarks and see each other."""

from collections.abc import Sequence
from functools import partial
from typing import TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxslam.math import se2
from jaxslam.simulation.scans import Visible, part_scan, side_by_side
from jaxslam.simulation.worlds import Scenario, drawn_near, drive
from jaxslam.team import Robot, TeamMotion, check_team, sensors_of, sizes
from jaxslam.types import Log, Scan, Truth


class TeamOptions(TypedDict, total=False):
    """Fields of `Scenario` that a world of a team may have, too."""

    visible: Visible
    published: dict[str, dict[str, float]]
    source: str


def team_world(
    robots: Sequence[Robot],
    landmarks: ArrayLike,
    controls: ArrayLike,
    *,
    tags: Sequence[int] | None = None,
    report: int = 0,
    name: str = "team",
    pose: ArrayLike = (0.0, 0.0, 0.0),
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    **options: Unpack[TeamOptions],
) -> Scenario:
    """A `Scenario` of several robots among landmarks (x, y), for `simulate` and `monte_carlo`.

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
        options: other fields of `Scenario`, see `TeamOptions`.
    Raises:
        ValueError: on no robots, tags that clash, a robot without start, one that is not there to
            report, and as `Scenario` does.
    """
    count = int(np.shape(landmarks)[0]) if np.ndim(landmarks) == 2 else 0
    own_tags = check_team("team_world", robots, tags, count)
    clash = [tag for tag in own_tags if tag < count]
    if clash:
        raise ValueError(
            f"team_world: expected tags of robots from {count} on, after the landmarks', got "
            f"{clash[0]}"
        )
    if any(robot.start is None for robot in robots[1:]):
        raise ValueError("team_world: expected a start of every robot but robot 0")
    if type(report) is not int or not 0 <= report < len(robots):
        raise ValueError(f"team_world: expected report from 0 to {len(robots) - 1}, got {report!r}")
    for what in ("places", "spurious", "noise_on", "draw"):
        if what in options:
            raise ValueError(f"team_world: {what} is not supported")
    return Scenario(
        name=name,
        motion=TeamMotion(tuple(robot.motion for robot in robots), report),
        sensor=sensors_of(robots, report),
        landmarks=landmarks,
        controls=controls,
        pose=pose,
        pose_cov=pose_cov,
        draw=partial(_draw, robots=tuple(robots), tags=own_tags, report=report),
        **options,
    )


def histories(
    scenario: Scenario, robots: Sequence[Robot], key: Array
) -> tuple[Float[Array, "R 3"], Float[Array, "R T 3"], Float[Array, "T ΣU"]]:
    """The starts, true paths and logged controls of all robots, as a `team_world` draws them."""
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
    key: Array,
    *,
    robots: tuple[Robot, ...],
    tags: tuple[int, ...],
    report: int,
) -> tuple[Truth, Log]:
    starts, poses, controls = histories(scenario, robots, key)
    landmarks = jnp.asarray(scenario.landmarks, poses.dtype)
    _, key_scan, _ = jax.random.split(key, 3)
    scans: list[tuple[Scan, Array]] = []
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
