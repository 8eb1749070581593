"""Which errors the noise alone allows: simulated odometry and measurements along the true paths."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from benchmarks import gate
from benchmarks.mrclam import fit as fitting
from jaxslam import charts, datasets, linearize
from jaxslam.consistency import block_nees, pose_error
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.record import record
from jaxslam.core.types import Log, Scan, Truth
from jaxslam.filters import EkfSlam
from jaxslam.math import se2
from jaxslam.motion import PoseIncrement

RUNS = 300
WHITE = 2.0
"""Window of the noise of the odometry [s]: what lasts longer is taken to be known exactly."""
START = np.diag([1e-3, 1e-3, 1e-3]) ** 2
"""Of the simulated start, which is taken to be known, too [m, m, rad]."""
LONGEST = 0.5
"""Between rows of a simulated log [s]."""


@record
class PoseIncrementWithDeviations(Motion):
    """Relative poses, whose standard deviations are the last three controls."""

    controls = (*PoseIncrement.controls, "σ forward [m]", "σ left [m]", "σ turn [rad]")
    noises = PoseIncrement.noises

    def step(self, pose: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
        return se2.compose(pose, u[:3] + w)

    def noise_cov(self, pose: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.diag(u[3:] ** 2)


class Course(NamedTuple):
    """What is the same in all simulated runs of a robot."""

    truth: Truth
    control: jax.Array
    """(T, 6) true increments, and the standard deviations of theirs"""
    scan: Scan
    """without noise"""
    motion: Motion
    sensor: Sensor
    options: dict[str, object]


class Replayed(NamedTuple):
    """Of the runs of a robot."""

    ate: np.ndarray
    """(K,) [m]"""
    nees: np.ndarray
    """(K,) median of the pose NEES"""
    bound: float
    """root of the mean of the ideal EKF's position variance [m]"""


def cut(log, row):
    """The log from a row on, which is the start: nothing moves before it."""
    log = jax.tree.map(lambda leaf: leaf[row:], log)
    return log._replace(control=jnp.asarray(log.control).at[0].set(0.0))


def from_first_scan(data, own=None):
    """The row of the first scan with a landmark at which the truth is known, and the log from it.

    own: the measurement slots of the robot that starts there; default all.
    """
    seen = data.log.scan.valid[:, :own].any(axis=1) & data.true_at
    row = int(np.argmax(seen))
    return row, cut(data.log, row)


def course(folder: Path, robot: int) -> Course:
    """The true path of a robot, and whom it saw when, with noise fitted on its truth."""
    own = fitting.fit(folder, robot, turned=True, window=WHITE)
    data = datasets.mrclam(folder, robot, calibration=own)
    row, log = from_first_scan(data)
    time, path, known = data.time[row:], data.true_path[row:], data.true_at[row:]
    keep, last = log.scan.valid.any(axis=1), time[0]
    for k, now in enumerate(time):  # scans, and rows between them where none is for long
        keep[k] |= k == 0 or now - last >= LONGEST
        last = now if keep[k] else last
    keep &= known
    time, path = time[keep], jnp.asarray(path[keep])
    scan = jax.tree.map(lambda leaf: jnp.asarray(leaf[keep]), log.scan)
    dt = np.diff(time, prepend=time[0])
    increment = jax.vmap(se2.between)(jnp.concatenate([path[:1], path[:-1]]), path)
    omega = np.asarray(increment[:, 2]) / np.where(dt > 0, dt, 1.0)
    turn = np.hypot(own.turn_noise, own.turn_share * omega)
    density = np.stack([np.full(len(dt), own.forward_noise), 0 * turn, turn], axis=1)
    control = jnp.concatenate([increment, np.sqrt(dt)[:, None] * density], axis=1)
    motion = PoseIncrementWithDeviations()
    sensor = own.sensor
    landmarks = jnp.asarray(data.landmarks)
    at = landmarks[jnp.maximum(scan.tag, 0)]
    scan = scan._replace(z=jax.vmap(jax.vmap(sensor.observe, (None, 0)))(path, at))
    truth = Truth(path, landmarks, np.zeros(len(path), np.int32), path[0])
    return Course(truth, control, scan, motion, sensor, dict(data.filter_options))


def replay(folder: Path, robot: int) -> Replayed:
    """Errors of the right-invariant EKF that knows all constants and the noise exactly."""
    at = course(folder, robot)
    capacity, chart = len(at.truth.landmarks), charts.RightInvariant()

    def run(key: jax.Array, ideal: bool) -> tuple[jax.Array, jax.Array]:
        moved, seen, first, rest = jax.random.split(key, 4)
        noise = at.control[:, 3:] * jax.random.normal(moved, at.control[:, 3:].shape)
        control = at.control.at[:, :3].add(noise)
        deviation = jax.vmap(jax.vmap(lambda z: jnp.sqrt(jnp.diag(at.sensor.noise_cov(z)))))
        z = at.scan.z + deviation(at.scan.z) * jax.random.normal(seen, at.scan.z.shape)
        start = jax.random.multivariate_normal(first, at.truth.start, START)
        kind = {"linearize": linearize.AtTruth(at.truth)} if ideal else {"chart": chart}
        filter = EkfSlam(at.motion, at.sensor, capacity, **at.options, **kind)
        log = Log(control, at.scan._replace(z=z))
        estimate = jaxslam.run(filter, log, start, START, rest).estimate
        return estimate.pose, estimate.pose_cov

    def several(keys: jax.Array, ideal: bool) -> tuple[np.ndarray, np.ndarray]:
        return jax.device_get(jax.jit(jax.vmap(partial(run, ideal=ideal)))(keys))

    poses, covs = several(jax.random.split(jax.random.key(robot), RUNS), False)
    error = pose_error(np.asarray(at.truth.pose), poses)
    ate = np.sqrt((error[..., :2] ** 2).sum(axis=2).mean(axis=1))
    each, regular = block_nees(poses, error, error, covs)["pose"]
    nees = np.nanmedian(np.where(regular, each, np.nan), axis=1)
    _, (cov,) = several(jax.random.split(jax.random.key(robot), 1), True)
    bound = float(np.sqrt((cov[:, 0, 0] + cov[:, 1, 1]).mean()))
    return Replayed(ate, nees, bound)


def table(folder: Path, robots: range, asked: tuple[float, float]) -> dict[int, Replayed]:
    """Prints noise of the heading by window, and what simulated runs come to."""
    headings = [
        [f"{robot}", *(f"{sigma:.4f}" for sigma in fitting.odometry(folder, robot).heading)]
        for robot in robots
    ]
    windows = [f"{seconds:g} s" for seconds in fitting.WINDOWS]
    print("\n" + gate.table(["robot", *windows], headings), flush=True)
    found, rows = {}, []
    for robot in robots:
        found[robot] = one = replay(folder, robot)
        ate, nees = (np.quantile(values, [0.05, 0.5, 0.95]) for values in (one.ate, one.nees))
        cells = [f"{robot}", f"{one.bound:.3f}", ", ".join(f"{x:.3f}" for x in ate)]
        cells += [f"{(one.ate <= asked[0]).mean():.3f}", ", ".join(f"{x:.2f}" for x in nees)]
        cells += [f"{(one.nees <= asked[1]).mean():.3f}"]
        rows.append(cells)
    heads = ["robot", "bound [m]", "ATE 5, 50, 95 % [m]", f"ATE at most {asked[0]}"]
    heads += ["NEES 5, 50, 95 %", f"NEES at most {asked[1]:g}"]
    print("\n" + gate.table(heads, rows), flush=True)
    return found
