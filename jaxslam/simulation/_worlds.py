"""The world generator: `simulate` draws a truth and the log a robot records, from a scenario and a
key."""

import functools
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jaxslam._origin import FAR, far_origin, move_near_origin, to_map_coordinates
from jaxslam._public import publish
from jaxslam.core._numbers import as_array, is_concrete
from jaxslam.core._record import FrozenDict, field, function_of, record, set_field, static
from jaxslam.core._validation import reworded_tracer_errors
from jaxslam.core.protocols import Component, Motion, Sensor, sensor_of_robot
from jaxslam.core.types import Log, Scan, Truth
from jaxslam.core.validation import (
    Check,
    InvalidField,
    at_least,
    covariance,
    finite,
    instance_of,
    one_of,
    or_none,
    prng_key,
    refusals_of,
    require,
)
from jaxslam.math._xla import quick_options
from jaxslam.math.angles import wrap
from jaxslam.sensors._suite import Suite, of_robot
from jaxslam.simulation._scans import (
    Visible,
    draw_gaussian,
    everywhere,
    normals_like,
    part_scan,
    sensor_scans,
    side_by_side,
)
from jaxslam.simulation.spurious import Spurious


class World(Component):
    """A simulated experiment: models, a map, controls, and options of the filters under test.

    A subclass is a record (`core.record`) that has these fields or properties and defines `draw`.
    Arrays are held on the host in float64 and enter a simulation in the dtype JAX is set to.
    """

    motion: Motion
    sensor: Sensor
    """models that filters and bounds assume"""
    landmarks: ArrayLike
    """(N, L) true landmarks; the tag of one is its row. May be traced: maps vary under `vmap`."""
    controls: ArrayLike
    """(T, U) nominal controls."""
    pose: ArrayLike
    """(3,) mean of the filter's prior of the pose before the first control; of a motion model with
    E further numbers in its state, of all R = 3 + E."""
    pose_cov: ArrayLike
    """(R, R) covariance of the true start about `pose`, and of that prior."""
    places: int | None = None
    """M measurement slots of a scan; None for as many as there are landmarks."""
    capacity: int | None = None
    """landmark slots of the filters of the catalog; None for as many as there are landmarks."""
    spurious: Spurious | None = None
    filter_options: dict[str, Any] = FrozenDict()
    """keyword arguments of `filters.EkfSlam` that belong to the experiment, as correction and gate;
    the filters of the catalog have them"""
    published: Mapping[str, Mapping[str, float]] = FrozenDict()
    """figures of the paper, by filter and by the names of `consistency.Summary.measures`."""
    source: str = ""
    """publication of the experiment"""
    recorded_runs: int | None = None
    """number of runs; None where they are drawn"""

    def __repr__(self) -> str:
        landmarks, models = np.shape(self.landmarks)[0], f"{self.motion.name}, {self.sensor.name}"
        contents = f"{self.name!r}, {self.steps} steps, {landmarks} landmarks, {models}"
        return f"{type(self).__name__}({contents})"

    def __post_init__(self) -> None:
        self._check(World, {"draw": "key"})
        # A subclass may have a property in place of a field.
        self._check_field("motion", instance_of(Motion))
        for name, check in {
            "sensor": instance_of(Sensor),
            "pose": finite(len(self.motion.state)),
            "pose_cov": covariance(len(self.motion.state)),
            "filter_options": FrozenDict.of,
            "published": FrozenDict.of,
        }.items():
            self._check_field(name, check)
        self._check_field("sensor", sensor_of_robot(self.motion.state))
        self._check_field("landmarks", _table_of(self.sensor.landmark))
        self._check_field("controls", _table_of(self.motion.controls))

    def _check_field(self, name: str, check: Check) -> None:
        """Check a field, or a property of that name."""
        value = require(name, getattr(self, name), check)
        if name in self.__dict__:
            set_field(self, name, value)

    @property
    def steps(self) -> int:
        """The number of steps T."""
        return int(np.shape(self.controls)[0])

    def draw(self, key: Array) -> tuple[Truth, Log]:
        """A random history: the truth, and the log of controls and noisy scans."""
        raise NotImplementedError

    def run(self, key: Array, number: int | Array) -> tuple[Truth, Log]:
        """The history of run `number` of a campaign with that key; traceable."""
        return draw_history(self, run_keys(key, number)[0])


@record
class Scenario(World):
    """A simulated experiment of one robot among landmarks.

    Raises ValueError on inconsistent shapes or values that are not finite.
    """

    name: str = static()
    motion: Motion = field()
    sensor: Sensor = field()
    landmarks: ArrayLike = field()
    """(N, L) true landmarks; the tag of one is its row. May be traced: maps vary under `vmap`."""
    controls: ArrayLike = field()
    """(T, U) nominal controls."""
    pose: ArrayLike = (0.0, 0.0, 0.0)
    """(3,) mean of the filter's prior of the pose before the first control; of a motion model with
    E further numbers in its state, of all R = 3 + E."""
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """(R, R) covariance of the true start about `pose`, and of that prior."""
    noise_on: Literal["robot", "odometry"] = static(
        default="robot", check=one_of("robot", "odometry")
    )
    """"robot": the noise moves the true robot, and the log holds the nominal control. "odometry":
    the true robot follows the nominal control, and the noise is on the control in the log."""
    visible: Visible = field(default=everywhere, check=function_of("pose", "l"))
    """the sensor's field of view."""
    places: int | None = static(default=None, check=or_none(at_least(1)))
    """M measurement slots of a scan; default N. The lowest tags get a slot first, and the landmarks
    in view beyond M are counted in `Truth.missed`."""
    spurious: Spurious | None = None
    """clutter, misses, outliers and wrong labels; where given, if only as `Spurious()`, the truth
    says which landmark each measurement is of, and associations are scored."""
    filter_options: dict[str, Any] = static(default=FrozenDict())
    """keyword arguments of `filters.EkfSlam` that belong to the experiment, as correction and gate;
    the filters of the catalog have them"""
    published: Mapping[str, Mapping[str, float]] = static(default=FrozenDict())
    """figures of the paper, by filter and by the names of `consistency.Summary.measures`."""
    source: str = static(default="")
    """publication of the experiment"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise_on == "odometry" and self.motion.perturb is None:
            raise InvalidField("motion", "expected one with `perturb` for noise on the odometry")
        if isinstance(self.sensor, Suite) and (self.places or self.spurious) is not None:
            raise InvalidField(
                "",
                "expected neither places nor spurious with a suite: each Part has its own places",
            )

    def draw(self, key: Array) -> tuple[Truth, Log]:
        """Draw the start, the path, the scans, and their spurious measurements."""
        dtype = jnp.result_type(float)
        controls = jnp.asarray(self.controls, dtype)
        landmarks = jnp.asarray(self.landmarks, dtype)
        # Three keys without spurious measurements: faults do not change the other draws.
        keys = jax.random.split(key, 3 if self.spurious is None else 4)
        key_motion, key_scan, key_start = keys[:3]
        start = random_pose(jnp.asarray(self.pose, dtype), self.pose_cov, key_start)
        robots, logged = drive(self.motion, start, controls, key_motion, self.noise_on)
        is_pose = len(self.motion.state) == 3
        poses, further = (robots, None) if is_pose else (robots[:, :3], robots[:, 3:])
        if isinstance(self.sensor, Suite):
            scan, missed = self._suite_scans(self.sensor, robots, landmarks, key_scan)
            return Truth(poses, landmarks, missed, start, further=further), Log(logged, scan)
        places = self.places or landmarks.shape[0]
        sensor = of_robot(self.sensor, self.motion.state)
        scan, missed = sensor_scans(sensor, self.visible, places, robots, landmarks, None, key_scan)
        truth = Truth(poses, landmarks, missed, start, further=further)
        if self.spurious is not None:
            spoil = partial(self.spurious.spoil, sensor)
            scan, origin = jax.vmap(spoil)(robots, scan, jax.random.split(keys[3], self.steps))
            truth = truth._replace(origin=origin)
        return truth, Log(logged, scan)

    def _suite_scans(
        self,
        sensors: Suite,
        poses: Float[Array, "T R"],
        landmarks: Float[Array, "N L"],
        key: Array,
    ) -> tuple[Scan, Int[Array, "T"]]:
        """The scans of all sensors of a single robot, side by side; it measures no other robot."""
        tags = jnp.arange(landmarks.shape[0])
        targets = {"landmarks": (landmarks, tags), "robots": (landmarks[:0], tags[:0])}
        keys = jax.random.split(key, len(sensors.parts))
        scans = [
            part_scan(part, self.motion.state, self.visible, poses, *targets[part.sees], part_key)
            for part, part_key in zip(sensors.parts, keys, strict=True)
        ]
        return side_by_side(scans, len(sensors.measurements))


def simulate(scenario: World, key: Array) -> tuple[Truth, Log]:
    """One random history of a world: the truth, and the log of controls and noisy scans.

    Of a world of recorded runs it is one of them.

    Traceable, so `jax.vmap(partial(simulate, scenario))(keys)` draws a batch. It is compiled once
    for a structure, as `run` is. The filters of a campaign all get the same draws.

    In float32, a world over 1 km from the origin of its coordinates is drawn with positions
    relative to its start, if that makes no difference to its models, and the truth is returned in
    float64, on the host: float32 could not hold it.
    """
    with refusals_of("simulate"):
        require("scenario", scenario, instance_of(World))
        require("key", key, prng_key)
    with (
        jax.transfer_guard("allow"),
        refusals_of(f"{scenario.name}: draw"),
        reworded_tracer_errors(),
    ):
        near: World | None = None
        origin = None
        # A new array is a tracer where a trace is active, also where all arguments are constants.
        if jnp.result_type(float) == jnp.float32 and is_concrete(scenario, key, jnp.zeros(())):
            origin = far_origin(scenario.pose, scenario.landmarks, FAR)
            near = None if origin is None else move_near_origin(scenario, origin, scenario.controls)
        if near is None or origin is None:
            history: tuple[Truth, Log] = _draw(scenario, key)
            return history
        truth, log = _draw(near, key)
        return to_map_coordinates(jax.device_get(truth), origin), log


@partial(jax.jit, inline=True)
def _draw(scenario: World, key: Array) -> tuple[Truth, Log]:
    return draw_history(scenario, key)


def draw_history(scenario: World, key: Array) -> tuple[Truth, Log]:
    """The truth and log that a world draws; raises InvalidField on anything else."""
    history = scenario.draw(key)
    kinds = tuple(map(type, history)) if isinstance(history, tuple) else (type(history),)
    if kinds != (Truth, Log):
        got = ", ".join(kind.__name__ for kind in kinds)
        raise InvalidField("draw", f"expected (Truth, Log), got {got}", owner=scenario.name)
    return history


def world_of_run(scenario: World, key: Array, number: int) -> tuple[Truth, Log]:
    """The truth and the log of run `number` of a campaign with that key.

    Raises ValueError where that run is not among the recorded ones.
    """
    most = scenario.recorded_runs
    if most is not None and not 0 <= number < most:
        reason = f"expected a run from 0 to {most - 1}, the recorded ones, got {number}"
        raise InvalidField("", reason, owner=scenario.name)
    with refusals_of(f"{scenario.name}: draw"), reworded_tracer_errors():
        history: tuple[Truth, Log] = _draw_run(scenario, key, number)
        return history


@jax.jit
def _draw_run(scenario: World, key: Array, number: int) -> tuple[Truth, Log]:
    return scenario.run(key, number)


def run_count(world: World) -> Check:
    """The check of a number of runs: an integer >= 1, at most as many as a world has recorded."""

    def check(value: Any) -> int:
        runs = int(at_least(1)(value))
        if (most := world.recorded_runs) is not None and runs > most:
            raise ValueError(
                f"expected at most {most}, the recorded runs of {world.name}, got {runs}"
            )
        return runs

    return check


BLOCK = 16
"""Number of runs of a campaign that a CPU draws together. The same number of a run has the same
bits at the same place in a block of the same size."""


def draw_block(scenario: World, key: Array, first: int) -> tuple[Truth, Log]:
    """The truths and logs (BLOCK, …) of the runs first, first + 1, … of a campaign, in NumPy.

    Compiled as the campaign compiles its draws, so that they have the bits of a campaign's on a
    CPU, if first is a multiple of BLOCK.
    """
    numbers = np.arange(first, first + BLOCK, dtype=jnp.result_type(int))
    program = _draws_program(jax.default_backend())
    owner = refusals_of(f"{scenario.name}: draw")
    with jax.transfer_guard("allow"), owner, reworded_tracer_errors():
        histories: tuple[Truth, Log] = jax.device_get(program(scenario, key, numbers))
        return histories


@functools.cache
def _draws_program(platform: str) -> Callable[..., tuple[Truth, Log]]:
    draw = jax.vmap(lambda scenario, key, number: scenario.run(key, number), (None, None, 0))
    return jax.jit(draw, compiler_options=quick_options(platform))


def run_keys(key: Array, number: int | Array) -> Array:
    """The two keys of a campaign's run of that number: of its world, and of its filter."""
    return jax.random.split(jax.random.fold_in(key, number))


def with_positions(sensor: Sensor, truth: Truth) -> Truth:
    """The truth with positions (N, 2) for landmarks other than points, as figures need them."""
    if sensor.of_points or not sensor.landmark:
        return truth
    return truth._replace(landmarks=jax.vmap(sensor.position)(jnp.asarray(truth.landmarks)))


def random_pose(pose: Float[Array, "R"], cov: ArrayLike, key: Array) -> Float[Array, "R"]:
    """A random pose, or robot, from the normal distribution of that mean and covariance (R, R)."""
    start = pose + draw_gaussian(jnp.asarray(cov, pose.dtype), normals_like(key, pose))
    return start.at[2].set(wrap(start[2]))


def drive(
    motion: Motion,
    start: Float[Array, "R"],
    controls: Float[Array, "T U"],
    key: Array,
    noise_on: str = "robot",
) -> tuple[Float[Array, "T R"], Float[Array, "T U"]]:
    """The true poses, or robots, and the controls that the robot's log shows."""
    normals = normals_like(key, jnp.zeros((controls.shape[0], len(motion.noises)), controls.dtype))

    def step(pose: Array, row: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        u, normal = row
        w = draw_gaussian(motion.noise_cov(pose, u), normal)
        if noise_on == "robot":
            pose = motion.step(pose, u, w)
            return pose, (pose, u)
        assert motion.perturb is not None
        pose = motion.step(pose, u, jnp.zeros_like(w))
        return pose, (pose, motion.perturb(u, w))

    _, history = jax.lax.scan(step, start, (controls, normals))
    return history


def _table_of(columns: tuple[str, ...]) -> Check:
    """The check of a table (N, C) of finite numbers with these C columns, N at least 1."""

    def check(value: ArrayLike) -> ArrayLike:
        shape = np.shape(value)
        if len(shape) != 2 or shape[1] != len(columns) or shape[0] == 0:
            raise ValueError(
                f"expected shape (N, {len(columns)}) with N >= 1, a row of {', '.join(columns)} "
                f"each, got {shape}"
            )
        if is_concrete(value):  # no tracer, as when maps are drawn under vmap
            table = np.asarray(value)
            if not np.issubdtype(table.dtype, np.number) or not np.all(np.isfinite(table)):
                raise ValueError("expected finite numbers")
        return as_array(value)

    return check


publish("jaxslam", World, Scenario, simulate)
