"""Worlds drawn from a recorded log: its twins.

The path and the map of a twin are the smoothed estimate of the log under its models; noises of
odometry and measurements are drawn. So a campaign judges a filter on the path, in the map and with
the fields of view of a robot without a known truth: a parametric bootstrap (Efron & Tibshirani, "An
Introduction to the Bootstrap", 1993, ch. 6).
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jaxslam._public import publish
from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import FrozenDict, field, record, static
from jaxslam.core.logs._tables import INTERVAL
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log, Truth
from jaxslam.core.validation import InvalidField, array_of, at_least, or_none, refusals_of, require
from jaxslam.math import _linalg as linalg
from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.sensors._suite import of_robot
from jaxslam.simulation._scans import draw_gaussian, noisy_scan, normals_like
from jaxslam.simulation._smoothed_log import RecordedLog, associates, smooth
from jaxslam.simulation._worlds import World, random_pose
from jaxslam.simulation.spurious import Spurious

_NEWTON = 4
"""Steps towards the control that undoes a noise; of small noises each doubles the digits."""


@record
class Twin(World):
    """A world whose path, map and fields of view are those of a recorded log (`twin`).

    The true path is x_t = f(x_{t-1}, u_t, ŵ_t) with the controls u of the log and the smoothed
    noises ŵ, from a start that is drawn as the prior says; path and map move with the start
    together. A noise w ~ N(0, Q) is drawn for each row, and the log of the twin holds the control
    u' with which the same motion comes about,

        f(x_{t-1}, u'_t, w_t) = f(x_{t-1}, u_t, ŵ_t).

    It is that of `perturb` where the motion model has one. Else Newton's method finds the nearest
    u', and the true path is where u' and w lead; Δt stays. Row t measures the landmarks that the
    log measured there, in its order, with noise R.

    What the robot has beside its pose, as a bias, is drawn anew: at the start as the prior says,
    and then as w changes it. u' is that with which the pose comes about, so the odometry of a twin
    has its own bias. A state that multiplies the odometry, as a scale, is found too small by the
    share σ²/v² of the noise in the square of the velocity, as always where the odometry, and not
    the path, is noisy (errors in variables): where that is no small part of its deviation, twins
    say little of it.
    """

    name: str = static()
    motion: Motion = field()
    sensor: Sensor = field()
    landmarks: ArrayLike = field()
    """(N, L) smoothed landmarks, those that the log measures"""
    controls: ArrayLike = field()
    """(T, U) of the log"""
    noise: ArrayLike = field()
    """(T, W) ŵ, the smoothed noises of the motions"""
    seen: ArrayLike = field(check=array_of("T", "M", kind=np.integer))
    """(T, M) row of the landmark that each measurement is of, -1 without a measurement"""
    time: ArrayLike = field(check=array_of("T"))
    """(T,) [s] of the rows since the first"""
    pose: ArrayLike = (0.0, 0.0, 0.0)
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    further: ArrayLike | None = None
    """(T, E) the smoothed numbers of the robot beside its pose, before each motion; None where
    E = 0"""
    spurious: Spurious | None = None
    """see `Scenario.spurious`"""
    capacity: int | None = static(default=None, check=or_none(at_least(1)))
    tags: tuple[int | str, ...] = static(default=())
    """(N,) names of the landmarks in the log"""
    left_out: int = static(default=0)
    """number of measurements of the log that the twin lacks, since nothing tells their landmark"""
    filter_options: dict[str, Any] = static(default=FrozenDict())
    published: Mapping[str, Mapping[str, float]] = static(default=FrozenDict())
    source: str = static(default="")
    """see `Scenario` for these fields"""

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = self.steps, len(self.motion.noises)
        require("noise", self.noise, array_of(*rows))
        if beside := len(self.motion.state) - 3:
            require("further", self.further, array_of(self.steps, beside))
        if not np.shape(self.seen)[0] == np.shape(self.time)[0] == self.steps:
            raise InvalidField("seen", f"expected {self.steps} rows, as of controls")
        if is_concrete(self.seen) and np.asarray(self.seen).max() >= np.shape(self.landmarks)[0]:
            raise InvalidField("seen", "expected rows of landmarks")

    @property
    def places(self) -> int:  # type: ignore[override]
        return int(np.shape(self.seen)[1])

    @property
    def associates(self) -> bool:
        """Whether its filters associate measurements themselves."""
        return associates(self.filter_options)

    def draw(self, key: Array) -> tuple[Truth, Log]:
        """Draw the start, the noises of the odometry, and those of the scans."""
        dtype = jnp.result_type(float)
        pose = jnp.asarray(self.pose, dtype)
        keys = jax.random.split(key, 3 if self.spurious is None else 4)
        key_motion, key_scan, key_start = keys[:3]
        start = random_pose(pose, self.pose_cov, key_start)
        # Without a sensor of absolute poses only a rigid motion of all is uncertain at the start.
        frame = se2.compose(start[:3], se2.inverse(pose[:3]))
        points = jnp.asarray(self.landmarks, dtype)
        landmarks = jax.vmap(self.sensor.move_landmark, (None, 0))(frame, points)
        normals = normals_like(key_motion, jnp.asarray(self.noise, dtype))
        robots, logged = self.drive(start, normals)
        is_pose = len(self.motion.state) == 3
        poses, further = (robots, None) if is_pose else (robots[:, :3], robots[:, 3:])
        sensor = of_robot(self.sensor, self.motion.state)
        seen = jnp.asarray(self.seen, jnp.int32)
        row_keys = jax.random.split(key_scan, self.steps)
        of_row = partial(noisy_scan, sensor)
        scan = jax.vmap(of_row, (0, None, 0, 0, 0))(robots, landmarks, seen, seen >= 0, row_keys)
        missed = jnp.zeros(self.steps, jnp.int32)
        truth = Truth(poses, landmarks, missed, start, further=further)
        if self.spurious is not None:
            spoil = partial(self.spurious.spoil, sensor)
            scan, origin = jax.vmap(spoil)(robots, scan, jax.random.split(keys[3], self.steps))
            truth = truth._replace(origin=origin)
        elif self.associates:
            truth = truth._replace(origin=scan.tag)
        return truth, Log(logged, scan)

    def drive(
        self, start: Float[Array, "R"], normals: Float[Array, "T W"]
    ) -> tuple[Float[Array, "T R"], Float[Array, "T U"]]:
        """The true poses, or robots, and the controls in the log, for a start and standard normals;
        traceable.

        With zeros from `pose` on: the smoothed path, and the controls that lead along it.
        """
        motion, dtype = self.motion, start.dtype
        controls, smoothed = (jnp.asarray(x, dtype) for x in (self.controls, self.noise))

        beside = jnp.zeros((self.steps, 0)) if self.further is None else self.further

        def step(robot: Array, row: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
            u, w_hat, normal, further_hat = row
            w = draw_gaussian(motion.noise_cov(robot, u), normal)
            if motion.perturb is not None and self.further is None:
                logged = motion.perturb(motion.perturb(u, w_hat), -w)
            else:
                smooth = jnp.concatenate([robot[:3], further_hat])
                target = motion.step(smooth, u, w_hat)
                logged = undoing_control(motion, robot, u, w, target)
            robot = motion.step(robot, logged, w)
            return robot, (robot, logged)

        rows = controls, smoothed, normals, jnp.asarray(beside, dtype)
        _, history = jax.lax.scan(step, start, rows)
        return history


def undoing_control(
    motion: Motion,
    robot: Float[Array, "R"],
    u: Float[Array, "U"],
    w: Float[Array, "W"],
    target: Float[Array, "R"],
) -> Float[Array, "U"]:
    """The control u' near u that, with the noise w, leads to the pose of the target:
    f(robot, u', w) ≈ target.

    Gauss-Newton on |f(pose, u', w) ⊖ target|²; Δt is that of u. A change that moves nothing, as at
    rest, is not made.
    """
    changes = np.array([name != INTERVAL for name in motion.controls], float)
    damping = float(jnp.finfo(u.dtype).eps) ** 0.75

    def gap(u: Array) -> Array:
        difference = target[:3] - motion.step(robot, u, w)[:3]
        return difference.at[2].set(wrap(difference[2]))

    moved = u
    for _ in range(_NEWTON):
        jacobian = -jax.jacfwd(gap)(moved) * changes[None]
        gram = jacobian.T @ jacobian
        size = jnp.trace(gram)
        moves = size > 0
        scale = damping * jnp.where(moves, size, 1.0)
        # The interval, which does not change, has an equation of its own.
        system = gram + jnp.diag(scale + jnp.where(moves, size, 1.0) * (1 - changes))
        step, _ = linalg.solve_psd(system, jacobian.T @ gap(moved))
        moved = moved + jnp.where(moves, step, 0.0) * changes
    return moved


def twin(dataset: RecordedLog, *, spurious: Spurious | None = None) -> Twin:
    """The world whose path and map are the smoothed estimate of a recorded log: its twin.

    `smoothing.BatchMap` finds path and map that are most likely given the log, its noises, its
    association and its gate (of ranges or bearings alone the same search, from the path of the
    odometry). Truth and survey of the data set are not looked at; where the start is
    that of the truth, it chooses the frame alone. With known tags every measurement of a landmark
    in the map is in the twin; without, those that the association used.

        world = jaxslam.simulation.twin(jaxslam.datasets.table(folder))
        filters = {"ekf": jaxslam.catalog.FILTERS["ekf"](world)}
        campaign = jaxslam.monte_carlo(world, filters, 100, jax.random.key(0))

    Args:
        dataset: a `datasets.Dataset`, as of `datasets.table`.
        spurious: outliers and other faults of the sensor to put into the scans; default those that
            the data set states.
    Raises:
        ValueError: on a log of several robots, a model whose odometry does not move the pose, or
            moves a number beside it, a log in which no landmark is seen twice, models without noise
            or with the defaults of a reader, a sensor that `BatchMap` refuses, and where the
            smoothing does not converge.
    """
    with refusals_of("twin"):
        if dataset.robots:
            raise InvalidField("dataset", "expected the log of one robot: choose one")
        _check_odometry(dataset)
        if dataset.default_noises:
            sections = " and ".join(f"[{name}]" for name in dataset.default_noises)
            raise InvalidField(
                "dataset",
                f"{dataset.name} states no noise of {sections}, and a twin from defaults says "
                "nothing of the robot: write it, or let jaxslam fit FOLDER --write find it",
            )
        scan = dataset.log.scan
        valid, tag = np.asarray(scan.valid), np.asarray(scan.tag)
        has_tags = not associates(dataset.filter_options)
        if has_tags:
            _check_seen_twice(np.where(valid, tag, -1))
        smoothed = smooth(dataset)
        for missing, section in ((smoothed.still, "motion"), (not smoothed.fused, "sensor")):
            if missing:
                raise InvalidField(
                    "dataset",
                    f"the {section} of {dataset.name} has no noise: write [{section}] noise, or "
                    "let jaxslam fit FOLDER --write find it",
                )
        count, seen = len(smoothed.landmarks), smoothed.seen
        names: tuple[int | str, ...] = tuple(range(count))
        if has_tags:  # what the gate rejected is of a landmark, too
            row_of_tag = np.full(max(int(tag.max()), int(smoothed.tag.max())) + 1, -1)
            row_of_tag[smoothed.tag] = np.arange(count)
            seen = np.where(valid & (tag >= 0), row_of_tag[np.maximum(tag, 0)], -1)
            names = tuple(dataset.tags[i] for i in smoothed.tag)
        _check_seen_twice(seen)
        return Twin(
            name=f"twin of {dataset.name}",
            motion=dataset.motion,
            sensor=dataset.sensor,
            landmarks=smoothed.landmarks,
            controls=np.asarray(dataset.log.control, np.float64),
            noise=smoothed.noise,
            further=smoothed.further if smoothed.further.shape[1] else None,
            seen=seen.astype(np.int32),
            time=np.asarray(dataset.time, np.float64) - float(dataset.time[0]),
            pose=np.asarray(dataset.pose, np.float64),
            pose_cov=np.asarray(dataset.pose_cov, np.float64),
            spurious=spurious or dataset.spurious,
            capacity=dataset.capacity,
            tags=names,
            left_out=int(valid.sum() - (seen >= 0).sum()),
            filter_options=dataset.filter_options,
            source=dataset.source,
        )


def _check_odometry(dataset: RecordedLog) -> None:
    """Raise InvalidField where, of a robot that has more than a pose, no odometry keeps a path."""
    motion, pose = dataset.motion, jnp.asarray(dataset.pose)
    if len(motion.state) == 3:
        return
    still = jnp.zeros(len(motion.noises), pose.dtype)
    measured = np.array([name != INTERVAL for name in motion.controls])
    by_control = jax.jit(jax.vmap(jax.jacfwd(lambda u: motion.step(pose, u, still))))(
        jnp.asarray(dataset.log.control, pose.dtype)
    )
    moves = np.asarray(by_control)[:, :, measured].any(axis=(0, 2))
    if not moves[:3].any() or moves[3:].any():
        raise InvalidField(
            "motion",
            "expected odometry that moves the pose and nothing else, so that noises of the "
            f"odometry leave the path as it is, got {motion.name} with "
            f"{', '.join(motion.state[3:])}",
        )


def _check_seen_twice(landmark: Int[np.ndarray, "T M"]) -> None:
    """Raise InvalidField unless a landmark is seen twice. landmark: of each measurement, or -1."""
    if np.bincount(landmark[landmark >= 0], minlength=1).max() < 2:
        raise InvalidField(
            "dataset",
            "expected a landmark that is seen twice, got none: without one nothing contradicts "
            "the odometry; take a longer log, or one with the landmarks' names",
        )


publish("jaxslam.simulation", Twin, twin)
