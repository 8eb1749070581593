"""Whether this installation computes right on this processor: `python -m jaxslam.selftest`.

A line for each check, with its number and the interval it must lie in, in a minute at most; the
exit status is 1 if one fails.
"""

import dataclasses
import sys
import time
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import graphs
from jaxslam._driver import run
from jaxslam.core.protocols import Filter
from jaxslam.core.types import Estimate, Log
from jaxslam.filters import EifSlam, EkfSlam
from jaxslam.math._arrays import float64
from jaxslam.math.stats import chi2_band
from jaxslam.motion import Increment, PoseIncrement
from jaxslam.results._files import versions
from jaxslam.sensors import RangeBearing, RelativePosition
from jaxslam.simulation import scenarios
from jaxslam.simulation._worlds import Scenario, simulate

__all__ = ["Check", "checks", "main"]

_STEPS, _RUNS = 25, 200
_POSTS = np.array([[2.0, 1.0], [-1.0, 3.0], [4.0, -2.0]])
_SIGMA = {"start": 0.1, "motion": 0.05, "sensor": 0.2, "heading": 1e-6}
"""Standard deviations of the linear world [m]; of the heading [rad], which makes it nonlinear, so
small that this is below the tolerances."""


class Check(NamedTuple):
    """A number, and the interval it must lie in."""

    name: str
    value: float
    high: float
    low: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether it does; NaN does not."""
        return bool(self.low <= self.value <= self.high)


def _linear_world() -> Scenario:
    """A robot that moves in x and y and sees relative positions: SLAM by a Kalman filter."""
    return Scenario(
        name="linear",
        motion=PoseIncrement(np.diag([_SIGMA["motion"], _SIGMA["motion"], _SIGMA["heading"]]) ** 2),
        sensor=RelativePosition(_SIGMA["sensor"] ** 2 * np.eye(2)),
        landmarks=_POSTS,
        controls=np.tile([0.1, 0.05, 0.0], (_STEPS, 1)),
        pose_cov=np.diag([_SIGMA["start"], _SIGMA["start"], _SIGMA["heading"]]) ** 2,
    )


def _cloister() -> Scenario:
    """The guide's world of 36 columns, from an uncertain start, without a gate."""
    return dataclasses.replace(scenarios.cloister(_STEPS), pose_cov=np.diag([0.1, 0.1, 0.05]) ** 2)


def _ekf_of(world: Scenario) -> EkfSlam:
    """EKF-SLAM with a slot for each landmark of a world."""
    return EkfSlam(world.motion, world.sensor, len(np.asarray(world.landmarks)), correction="joint")


def _estimate_of(filter: Filter, world: Scenario, log: Log) -> Estimate:
    """The estimates of a filter in a world."""
    start = jnp.asarray(world.pose, float), jnp.asarray(world.pose_cov, float)
    return run(filter, log, *start, jax.random.key(0)).estimate


def _kalman_filter(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the position and the three posts, in the linear world, by NumPy."""
    count = 2 + 2 * len(_POSTS)
    mean = np.zeros(count)  # with 1e9 for posts that were never seen
    cov = np.diag(np.repeat([_SIGMA["start"] ** 2, 1e9], [2, count - 2]))
    H = np.hstack([np.tile(-np.eye(2), (len(_POSTS), 1)), np.eye(count - 2)])
    R = _SIGMA["sensor"] ** 2 * np.eye(count - 2)
    for u, z, tag in zip(log.control, log.scan.z, log.scan.tag, strict=True):
        mean[:2] += np.asarray(u)[:2]
        cov[:2, :2] += _SIGMA["motion"] ** 2 * np.eye(2)
        gain = np.linalg.solve(H @ cov @ H.T + R, H @ cov).T
        mean = mean + gain @ (np.asarray(z)[np.argsort(tag)].ravel() - H @ mean)
        I_KH = np.eye(count) - gain @ H
        cov = I_KH @ cov @ I_KH.T + gain @ R @ gain.T
    return mean, cov


def _against_kalman(log: Log, device: jax.Device) -> Check:
    """EKF-SLAM on a device against the Kalman filter, in the linear world."""
    mean, cov = _kalman_filter(log)
    with jax.default_device(device):
        estimate = jax.device_get(_estimate_of(_ekf_of(_linear_world()), _linear_world(), log))
    order = np.argsort(estimate.tag[-1])
    means = np.append(estimate.pose[-1, :2], estimate.points[-1, order])
    covs = estimate.pose_cov[-1, :2, :2], estimate.point_covs[-1, order[0]]
    off = means - mean, covs[0] - cov[:2, :2], covs[1] - cov[2:4, 2:4]
    worst = max(float(np.abs(difference).max()) for difference in off)
    return Check(f"EKF-SLAM against a Kalman filter by NumPy, {device} [m]", worst, 1e-7)


def _information_form(log: Log) -> Check:
    """The information filter against EKF-SLAM, in the cloister."""
    world, eif = _cloister(), EifSlam(_cloister().motion, _cloister().sensor, 36)
    dense, information = (_estimate_of(filter, world, log) for filter in (_ekf_of(world), eif))
    pairs = zip(dense[:4], information[:4], strict=True)
    worst = max(float(jnp.abs(a - b).max()) for a, b in pairs)
    return Check("information form against covariance form", worst, 1e-7)


def _graph(log: Log) -> Check:
    """The optimum of the graph of a log against the filter, at the last pose of a linear world."""
    world = _linear_world()
    start, cov = np.asarray(world.pose), np.asarray(world.pose_cov)
    initial, factors = graphs.of_log(log, world.motion, world.sensor, start, cov)
    optimum = graphs.optimize(initial, factors, tolerance=1e-16).graph.poses[-1]
    filtered = _estimate_of(_ekf_of(world), world, log).pose[-1]
    off = float(jnp.abs(optimum - filtered)[:2].max())
    return Check("optimum of a graph against EKF-SLAM, linear [m]", off, 1e-7)


def _gradient(log: Log) -> Check:
    """The gradient of the log-likelihood by four noises against differences of fourth order."""
    world, at = _cloister(), np.array([0.01, 0.02, 0.1, np.deg2rad(1.0)])

    def log_likelihood(sigma: jax.Array) -> jax.Array:
        models = Increment(jnp.diag(sigma[:2] ** 2)), RangeBearing(jnp.diag(sigma[2:] ** 2))
        filter = EkfSlam(*models, 36, correction="joint")
        start, cov = jnp.asarray(world.pose), jnp.asarray(world.pose_cov)
        return run(filter, log, start, cov, jax.random.key(0)).info.log_likelihood.sum()

    both = jax.jit(jax.value_and_grad(log_likelihood))
    slope, steps = np.asarray(both(at)[1]), 1e-3 * np.diag(at)
    ends = [np.array([float(both(at + k * step)[0]) for step in steps]) for k in (-2, -1, 1, 2)]
    numeric = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * np.diag(steps))
    off = float((np.abs(slope - numeric) / np.abs(numeric)).max())
    return Check("gradient of a run against differences, relative", off, 1e-6)


def _single_precision(log: Log) -> Check:
    """EKF-SLAM in float32 against float64 in the cloister: difference of poses over σ."""
    world = _cloister()
    double = jax.device_get(_estimate_of(_ekf_of(world), world, log))
    short = jax.tree.map(lambda x: np.asarray(x, np.float32 if x.dtype == float else x.dtype), log)
    start, cov = (np.asarray(value, np.float32) for value in (world.pose, world.pose_cov))
    single = jax.device_get(run(_ekf_of(world), short, start, cov, jax.random.key(0)).estimate)
    assert single.pose.dtype == np.float32
    variance = np.diagonal(double.pose_cov, axis1=1, axis2=2)
    off = float((np.abs(single.pose - double.pose) / np.sqrt(variance)).max())
    return Check("float32 against float64, poses over σ", off, 1e-3)


def _consistency() -> Check:
    """The average NEES of the last position over runs of the linear world."""
    world = _linear_world()

    def nees(key: jax.Array) -> jax.Array:
        truth, log = simulate(world, key)
        last = _estimate_of(_ekf_of(world), world, log)
        error = (last.pose[-1] - truth.pose[-1])[:2]
        return jnp.vdot(error, jnp.linalg.solve(last.pose_cov[-1, :2, :2], error))

    average = jax.jit(jax.vmap(nees))(jax.random.split(jax.random.key(0), _RUNS)).mean()
    low, high = chi2_band(2, _RUNS, 0.999)
    return Check(f"NEES of the position, {_RUNS} runs", float(average), high, low)


def checks() -> Iterator[Check]:
    """The checks, one after the other; float64 and exact products of matrices within each."""
    with float64(), jax.default_matmul_precision("highest"):
        worlds = _linear_world(), _cloister()
        line, columns = (jax.device_get(simulate(world, jax.random.key(0))[1]) for world in worlds)
        for device in jax.devices():
            yield _against_kalman(line, device)
        yield _information_form(columns)
        yield _graph(line)
        yield _gradient(columns)
        yield _single_precision(columns)
        yield _consistency()


def main() -> int:
    """Print the checks; the exit status."""
    began, failed = time.perf_counter(), 0
    print(", ".join(f"{name} {version}" for name, version in versions().items()), flush=True)
    for check in checks():
        line = f"{check.name:<62} {check.value:10.3g}  in [{check.low:.4g}, {check.high:.4g}]"
        print("ok    " if check.passed else "FAILED", line, sep="  ", flush=True)
        failed += not check.passed
    print(f"{failed} failed, {time.perf_counter() - began:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
