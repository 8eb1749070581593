"""The world generator: a scenario and a key give a truth and the log a robot would record in it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.angles import wrap
from jaxslam.linalg import check_covariance, is_concrete, root_psd
from jaxslam.protocols import Motion, Sensor
from jaxslam.spurious import Spurious, spoil
from jaxslam.types import Log, Scan, Truth


def everywhere(pose: jax.Array, landmark: jax.Array) -> jax.Array:
    """Every landmark is seen from every pose."""
    return jnp.asarray(True)


@dataclass(frozen=True, eq=False)
class Scenario:
    """An experiment: models, world, controls, and how the filters under test are set up.

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
    visible: Callable[[jax.Array, jax.Array], jax.Array] = everywhere
    """(pose, l) -> (): whether the sensor reports the landmark from there."""
    places: int | None = None
    """M measurement places a scan; default N. The lowest tags first get a place, and the landmarks
    in view beyond M are counted in `Truth.missed`."""
    spurious: Spurious | None = None
    """clutter, misses, outliers and wrong labels; where given, if only as `Spurious()`, the truth
    says which landmark each measurement is of, and associations are scored."""
    filter_options: dict[str, Any] = field(default_factory=dict)
    """keyword arguments of `filters.ekf_slam` that belong to the experiment: update, gate, …"""
    published: dict[str, dict[str, float]] = field(default_factory=dict)
    """figures of the paper, by filter and by the names of `consistency.Summary.measures`."""
    source: str = ""
    """where the experiment is published."""

    def __post_init__(self) -> None:
        size_l, size_u = len(self.sensor.landmark), len(self.motion.controls)
        _check_table(f"{self.name}: landmarks", self.landmarks, size_l)
        _check_table(f"{self.name}: controls", self.controls, size_u)
        _check_table(f"{self.name}: pose", np.reshape(self.pose, (1, -1)), 3)
        check_covariance(f"{self.name}: pose_cov", self.pose_cov, 3)
        if self.noise_on not in ("robot", "odometry"):
            raise ValueError(f'{self.name}: noise_on must be "robot" or "odometry"')
        if self.noise_on == "odometry" and self.motion.perturb is None:
            raise ValueError(f"{self.name}: noise on the odometry needs a motion with `perturb`")
        if self.places is not None and self.places < 1:
            raise ValueError(f"{self.name}: expected places >= 1, got {self.places}")

    @property
    def steps(self) -> int:
        """T."""
        return int(np.shape(self.controls)[0])


def simulate(scenario: Scenario, key: jax.Array) -> tuple[Truth, Log]:
    """Draw one world history: true poses and the log of noisy controls or motion, and noisy scans.

    Traceable, so `jax.vmap(partial(simulate, scenario))(keys)` draws a batch. The filters of a
    campaign all get the same draws.
    """
    dtype = jnp.result_type(float)
    controls = jnp.asarray(scenario.controls, dtype)
    landmarks = jnp.asarray(scenario.landmarks, dtype)
    if scenario.spurious is None:
        key_motion, key_scan, key_start = jax.random.split(key, 3)
    else:
        key_motion, key_scan, key_start, key_spoil = jax.random.split(key, 4)
    start = jnp.asarray(scenario.pose, dtype)
    start = start + _draw(jnp.asarray(scenario.pose_cov, dtype), _normals(key_start, start))
    start = start.at[2].set(wrap(start[2]))
    poses, logged = _drive(scenario, start, controls, key_motion)

    count = landmarks.shape[0]
    places = min(scenario.places or count, count)
    seen = jax.vmap(jax.vmap(scenario.visible, (None, 0)), (0, None))(poses, landmarks)
    if places < count:
        tag = jnp.argsort(~seen, axis=1, stable=True)[:, :places]
        valid = jnp.take_along_axis(seen, tag, axis=1)
    else:
        tag, valid = jnp.broadcast_to(jnp.arange(count), seen.shape), seen
    keys = jax.random.split(key_scan, scenario.steps)

    def measure(pose: jax.Array, tags: jax.Array, key: jax.Array) -> jax.Array:
        exact = jax.vmap(scenario.sensor.observe, (None, 0))(pose, landmarks[tags])
        noise = jax.vmap(_draw)(jax.vmap(scenario.sensor.noise_cov)(exact), _normals(key, exact))
        return jax.vmap(scenario.sensor.residual)(exact + noise, jnp.zeros_like(exact))

    z = jax.vmap(measure)(poses, tag, keys)
    scan = Scan(
        z=jnp.where(valid[:, :, None], z, 0.0),
        tag=jnp.where(valid, tag, -1).astype(jnp.int32),
        valid=valid,
    )
    truth = Truth(poses, landmarks, seen.sum(axis=1) - valid.sum(axis=1), start)
    if scenario.spurious is not None:
        wrong = partial(spoil, scenario.spurious, scenario.sensor)
        scan, origin = jax.vmap(wrong)(poses, scan, jax.random.split(key_spoil, scenario.steps))
        truth = truth._replace(origin=origin)
    return truth, Log(logged, scan)


def _drive(
    scenario: Scenario, start: jax.Array, controls: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """True poses (T, 3) and the controls (T, U) that the robot's log shows."""
    motion = scenario.motion
    normals = _normals(key, jnp.zeros((controls.shape[0], len(motion.noises)), controls.dtype))

    def step(
        pose: jax.Array, row: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        u, normal = row
        w = _draw(motion.noise_cov(pose, u), normal)
        if scenario.noise_on == "robot":
            pose = motion.step(pose, u, w)
            return pose, (pose, u)
        assert motion.perturb is not None
        pose = motion.step(pose, u, jnp.zeros_like(w))
        return pose, (pose, motion.perturb(u, w))

    _, history = jax.lax.scan(step, start, (controls, normals))
    return history


def _normals(key: jax.Array, like: jax.Array) -> jax.Array:
    return jax.random.normal(key, like.shape, like.dtype)


def _draw(cov: jax.Array, normal: jax.Array) -> jax.Array:
    """N(0, cov) from standard normals; cov may be singular or zero."""
    return root_psd(cov) @ normal


def _check_table(name: str, values: ArrayLike, columns: int) -> None:
    shape = np.shape(values)
    if len(shape) == 2 and shape[1] == columns and shape[0] > 0 and not is_concrete(values):
        return  # a tracer, as when maps are drawn under vmap
    table = np.asarray(values)
    if table.ndim != 2 or table.shape[1] != columns or table.shape[0] == 0:
        raise ValueError(f"{name}: expected shape (at least 1, {columns}), got {table.shape}")
    if not np.issubdtype(table.dtype, np.number) or not np.all(np.isfinite(table)):
        raise ValueError(f"{name}: expected finite numbers")
