"""The world generator: `simulate` draws a truth and the log a robot records, from a scenario and a
key."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jaxslam import programs
from jaxslam.core.numbers import check_covariance, check_key, is_concrete
from jaxslam.filters.ekf.settings import EkfOptions
from jaxslam.math.angles import wrap
from jaxslam.protocols import Motion, Sensor
from jaxslam.sensors.suite import Suite
from jaxslam.simulation.scans import (
    Visible,
    draw_gaussian,
    everywhere,
    normals_like,
    part_scan,
    sensor_scans,
    side_by_side,
)
from jaxslam.simulation.spurious import Spurious, spoil
from jaxslam.types import Log, Scan, Truth
from jaxslam.validation import check_record


@dataclass(frozen=True, eq=False, repr=False)
class Scenario:
    """A simulated experiment: models, world, controls, and options of the filters under test.

    Arrays are held on the host in float64 and enter a simulation in the dtype JAX is set to.
    Raises ValueError on inconsistent shapes or values that are not finite.
    """

    name: str
    motion: Motion
    sensor: Sensor
    landmarks: ArrayLike
    """(N, L) true landmarks; the tag of one is its row. May be traced: maps vary under `vmap`."""
    controls: ArrayLike
    """(T, U) nominal controls."""
    pose: ArrayLike = (0.0, 0.0, 0.0)
    """(3,) what a filter is told of the pose before the first control."""
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """(3, 3) how far from there, by a Gaussian draw, the robot truly starts."""
    noise_on: Literal["robot", "odometry"] = "robot"
    """"robot": the noise moves the true robot, and the log holds the nominal control. "odometry":
    the true robot follows the nominal control, and the noise is on the control in the log."""
    visible: Visible = everywhere
    """the sensor's field of view."""
    places: int | None = None
    """M measurement slots of a scan; default N. The lowest tags get a slot first, and the landmarks
    in view beyond M are counted in `Truth.missed`."""
    spurious: Spurious | None = None
    """clutter, misses, outliers and wrong labels; where given, if only as `Spurious()`, the truth
    says which landmark each measurement is of, and associations are scored."""
    filter_options: EkfOptions = field(default_factory=EkfOptions)
    """keyword arguments of `filters.EkfSlam` that belong to the experiment: update, gate, …"""
    draw: Callable[["Scenario", Array], tuple[Truth, Log]] | None = None
    """(scenario, key) -> truth, log: a world of another kind (`team_world`); None for `simulate`'s
    own."""
    recorded: tuple[Truth, Log] | None = None
    """with leading axes over R runs: the records that runs 0 to R - 1 of a campaign are, instead of
    draws (`recorded_world`)."""
    published: dict[str, dict[str, float]] = field(default_factory=dict)
    """figures of the paper, by filter and by the names of `consistency.Summary.measures`."""
    source: str = ""
    """where the experiment is published."""

    def __repr__(self) -> str:
        landmarks, steps = np.shape(self.landmarks)[0], np.shape(self.controls)[0]
        models = f"{self.motion.name}, {self.sensor.name}"
        return f"Scenario({self.name!r}, {steps} steps, {landmarks} landmarks, {models})"

    def __post_init__(self) -> None:
        what = f"Scenario {self.name!r}"
        size_l, size_u = len(self.sensor.landmark), len(self.motion.controls)
        _check_table(f"{what}: landmarks", self.landmarks, size_l)
        _check_table(f"{what}: controls", self.controls, size_u)
        if np.shape(self.pose) != (3,):
            raise ValueError(f"{what}: pose: expected shape (3,), got {np.shape(self.pose)}")
        _check_table(f"{what}: pose", np.reshape(self.pose, (1, -1)), 3)
        check_covariance(f"{what}: pose_cov", self.pose_cov, 3)
        if self.noise_on not in ("robot", "odometry"):
            raise ValueError(
                f'{what}: expected noise_on "robot" or "odometry", got {self.noise_on!r}'
            )
        if self.noise_on == "odometry" and self.motion.perturb is None:
            raise ValueError(f"{what}: expected a motion with `perturb` for noise on the odometry")
        if self.places is not None and self.places < 1:
            raise ValueError(f"{what}: expected places >= 1, got {self.places}")
        if isinstance(self.sensor, Suite) and (self.places or self.spurious) is not None:
            raise ValueError(
                f"{what}: expected neither places nor spurious with a suite: each Part has "
                "its own places"
            )

    @property
    def steps(self) -> int:
        """The number of steps T."""
        return int(np.shape(self.controls)[0])


def simulate(scenario: Scenario, key: Array) -> tuple[Truth, Log]:
    """One random history of a world: the truth, and the log of controls and noisy scans.

    Of a world of recorded runs it is one of them.

    Traceable, so `jax.vmap(partial(simulate, scenario))(keys)` draws a batch. Called outside a
    trace it is compiled once for a structure, as `run` is. The filters of a campaign all get the
    same draws.
    """
    check_record("simulate", "scenario", scenario, Scenario)
    check_key("simulate", key)
    return programs.call(_simulate, (scenario,), key)


def run_keys(key: Array, number: int | Array) -> Array:
    """The two keys of a campaign's run of that number: of its world, and of its filter."""
    return jax.random.split(jax.random.fold_in(key, number))


def world_of_run(scenario: Scenario, key: Array, number: int | Array) -> tuple[Truth, Log]:
    """The truth and the log of run `number` of a campaign with that key; traceable.

    Raises ValueError where that run is not among the recorded ones, if the number is concrete.
    """
    if scenario.recorded is not None:
        runs = len(scenario.recorded[0].pose)
        if is_concrete(number) and not 0 <= int(number) < runs:
            raise ValueError(
                f"Scenario {scenario.name!r}: expected a run from 0 to {runs - 1}, the recorded "
                f"ones, got {number}"
            )
        return _record(scenario.recorded, number)
    return simulate(scenario, run_keys(key, number)[0])


def _record(recorded: tuple[Truth, Log], number: int | Array) -> tuple[Truth, Log]:
    found: tuple[Truth, Log] = jax.tree.map(lambda leaf: jnp.asarray(leaf)[number], recorded)
    return found


def _simulate(scenario: Scenario, key: Array) -> tuple[Truth, Log]:
    """Draw the start, the path, the scans, and what is spurious in them."""
    if scenario.recorded is not None:
        runs = len(scenario.recorded[0].pose)
        return _record(scenario.recorded, jax.random.randint(key, (), 0, runs))
    if scenario.draw is not None:
        return scenario.draw(scenario, key)
    dtype = jnp.result_type(float)
    controls = jnp.asarray(scenario.controls, dtype)
    landmarks = jnp.asarray(scenario.landmarks, dtype)
    # Three keys where nothing is spurious: faults do not change what is drawn without them.
    keys = jax.random.split(key, 3 if scenario.spurious is None else 4)
    key_motion, key_scan, key_start = keys[:3]
    start = drawn_near(jnp.asarray(scenario.pose, dtype), scenario.pose_cov, key_start)
    poses, logged = drive(scenario.motion, start, controls, key_motion, scenario.noise_on)
    if isinstance(scenario.sensor, Suite):
        scan, missed = _suite_scans(scenario, scenario.sensor, poses, landmarks, key_scan)
        return Truth(poses, landmarks, missed, start), Log(logged, scan)
    places = scenario.places or landmarks.shape[0]
    scan, missed = sensor_scans(
        scenario.sensor, scenario.visible, places, poses, landmarks, None, key_scan
    )
    truth = Truth(poses, landmarks, missed, start)
    if scenario.spurious is not None:
        wrong = partial(spoil, scenario.spurious, scenario.sensor)
        scan, origin = jax.vmap(wrong)(poses, scan, jax.random.split(keys[3], scenario.steps))
        truth = truth._replace(origin=origin)
    return truth, Log(logged, scan)


def _suite_scans(
    scenario: Scenario,
    sensors: Suite,
    poses: Float[Array, "T 3"],
    landmarks: Float[Array, "N L"],
    key: Array,
) -> tuple[Scan, Int[Array, "T"]]:
    """The scans of all sensors of a lone robot, side by side; it sees no other robot."""
    tags = jnp.arange(landmarks.shape[0])
    targets = {"landmarks": (landmarks, tags), "robots": (landmarks[:0], tags[:0])}
    keys = jax.random.split(key, len(sensors.parts))
    scans = [
        part_scan(part, scenario.visible, poses, *targets[part.sees], part_key)
        for part, part_key in zip(sensors.parts, keys, strict=True)
    ]
    return side_by_side(scans, len(sensors.measurements))


def with_positions(sensor: Sensor, truth: Truth) -> Truth:
    """The truth with positions (N, 2) for landmarks that are no points, as figures need them."""
    if sensor.of_points or not sensor.landmark:
        return truth
    return truth._replace(landmarks=jax.vmap(sensor.position)(jnp.asarray(truth.landmarks)))


def drawn_near(pose: Float[Array, "3"], cov: ArrayLike, key: Array) -> Float[Array, "3"]:
    """A random pose, from the normal distribution of that mean and covariance (3, 3)."""
    start = pose + draw_gaussian(jnp.asarray(cov, pose.dtype), normals_like(key, pose))
    return start.at[2].set(wrap(start[2]))


def drive(
    motion: Motion,
    start: Float[Array, "3"],
    controls: Float[Array, "T U"],
    key: Array,
    noise_on: str = "robot",
) -> tuple[Float[Array, "T 3"], Float[Array, "T U"]]:
    """The true poses, and the controls that the robot's log shows."""
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


def _check_table(name: str, values: ArrayLike, columns: int) -> None:
    shape = np.shape(values)
    if len(shape) == 2 and shape[1] == columns and shape[0] > 0 and not is_concrete(values):
        return  # a tracer, as when maps are drawn under vmap
    table = np.asarray(values)
    if table.ndim != 2 or table.shape[1] != columns or table.shape[0] == 0:
        raise ValueError(f"{name}: expected shape (N, {columns}) with N >= 1, got {table.shape}")
    if not np.issubdtype(table.dtype, np.number) or not np.all(np.isfinite(table)):
        raise ValueError(f"{name}: expected finite numbers")
