"""Fit motion and sensor noise by maximum likelihood, on simulated runs or on a robot's own log.

    python examples/fit_noise.py
    python examples/fit_noise.py --mrclam FOLDER --robot 1 --steps 10000

The likelihood is the filter's own, Σ log N(innovation; 0, S) over the run. `jax.grad` takes its
derivative through every step, and SciPy's BFGS climbs it in log σ from starts a factor 5 off.
Standard errors are those of the observed information, the inverse Hessian at the optimum.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import jaxslam
from jaxslam.datasets.mrclam import ODOMETRY_DENSITY, mrclam, white_noise

OFF = np.array([5.0, 0.2, 0.2, 5.0])
"""How far from the truth, or the reader's defaults, the four parameters start."""


class Fit(NamedTuple):
    """Parameters (4,) as standard deviations; standard errors are of their logarithms."""

    sigma: np.ndarray
    error: np.ndarray
    start: np.ndarray
    log_likelihood: float
    log_likelihood_start: float
    gradient: np.ndarray
    """of the log-likelihood by log σ at the optimum, in units of its own standard error"""
    evaluations: int


def fit(log_likelihood: Callable[[jax.Array], jax.Array], start: np.ndarray) -> Fit:
    """Maximize log_likelihood(σ) over σ (4,) > 0, in log σ, from start."""
    both = jax.jit(jax.value_and_grad(lambda log_sigma: -log_likelihood(jnp.exp(log_sigma))))
    at_start = float(both(jnp.log(start))[0])
    scale = 1 / max(abs(at_start), 1.0)  # so that BFGS's first step is a short one

    def objective(log_sigma: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = both(jnp.asarray(log_sigma))
        return scale * float(value), scale * np.asarray(slope)

    found = minimize(objective, np.log(start), jac=True, method="BFGS", options={"gtol": 1e-7})
    steps = 1e-3 * np.eye(len(start))
    slopes = [[both(jnp.asarray(found.x + sign * h))[1] for sign in (1, -1)] for h in steps]
    hessian = np.array([(np.asarray(a) - np.asarray(b)) / 2e-3 for a, b in slopes])
    cov = np.linalg.inv((hessian + hessian.T) / 2)
    error = np.sqrt(np.diagonal(cov))
    value, slope = both(jnp.asarray(found.x))
    return Fit(
        sigma=np.exp(found.x),
        error=error,
        start=np.asarray(start),
        log_likelihood=-float(value),
        log_likelihood_start=-at_start,
        gradient=-np.asarray(slope) * error,
        evaluations=int(found.nfev),
    )


TRUE = np.array([0.02, 0.01, 0.05, np.deg2rad(1.0)])
SIMULATED = ("forward [m]", "turn [rad]", "range [m]", "bearing [rad]")
POINTS = np.array([[3.0, 1.0], [-1.0, 4.0], [-3.0, -1.0], [2.0, -3.0]])


def simulated(runs: int = 8, steps: int = 200, seed: int = 0) -> Callable[[jax.Array], jax.Array]:
    """The log-likelihood of independent runs round four landmarks, whose true noise is TRUE."""

    def models(sigma: Any) -> tuple[Any, Any]:
        noise = jnp.asarray(sigma) ** 2
        sensor = jaxslam.sensors.range_bearing(jnp.diag(noise[2:]))
        return jaxslam.motion.increment(jnp.diag(noise[:2])), sensor

    motion, sensor = models(TRUE)
    controls = np.tile([0.1, 4 * np.pi / 200], (steps, 1))
    world = jaxslam.Scenario("square", motion, sensor, landmarks=POINTS, controls=controls)
    keys = jax.random.split(jax.random.key(seed), runs)
    _, logs = jax.jit(jax.vmap(partial(jaxslam.simulate, world)))(keys)

    def log_likelihood(sigma: jax.Array) -> jax.Array:
        ekf = jaxslam.filters.ekf_slam(*models(sigma), capacity=len(POINTS), update="joint")

        def of_run(log: Any, key: jax.Array) -> jax.Array:
            trace = jaxslam.run(ekf, log, world.pose, world.pose_cov, key)
            return trace.info.log_likelihood.sum()

        return jax.vmap(of_run)(logs, keys).sum()

    return log_likelihood


RECORDED = ("travel [m/√s]", "heading [rad/√s]", "range [m]", "bearing [rad]")


def recorded(data: Any, steps: int) -> Callable[..., Any]:
    """The log-likelihood of the first rows of a log of `datasets.mrclam`, and NIS/dof beside it."""
    log = jax.tree.map(lambda a: jnp.asarray(a[:steps]), data.log)

    def log_likelihood(sigma: jax.Array) -> tuple[jax.Array, jax.Array]:
        motion = jaxslam.motion.unicycle(white_noise(sigma[0] ** 2, sigma[1] ** 2))
        sensor = jaxslam.sensors.range_bearing(jnp.diag(sigma[2:] ** 2))
        ekf = jaxslam.filters.ekf_slam(motion, sensor, data.capacity, **data.filter_options)
        key = jax.random.key(0)
        info = jaxslam.run(ekf, log, data.pose, data.pose_cov, key).info
        return info.log_likelihood.sum(), info.nis.sum() / jnp.maximum(info.dof.sum(), 1)

    return log_likelihood


def table(names: tuple[str, ...], result: Fit, reference: np.ndarray, called: str) -> str:
    """One line a parameter; z is the distance from the reference in standard errors of log σ."""
    z = np.log(result.sigma / reference) / result.error
    lines = [f"{'':16}{called:>12}{'start':>12}{'fitted':>12}{'std. error':>12}{'z':>8}"]
    rows = zip(names, reference, result.start, result.sigma, result.error, z, strict=True)
    for name, true, start, sigma, error, off in rows:
        lines.append(
            f"{name:16}{true:12.5f}{start:12.5f}{sigma:12.5f}{sigma * error:12.5f}{off:8.2f}"
        )
    lines.append(
        f"log-likelihood {result.log_likelihood_start:.1f} -> {result.log_likelihood:.1f}, "
        f"{result.evaluations} evaluations"
    )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--mrclam", metavar="FOLDER", help="fit on a robot of this data set")
    parser.add_argument("--robot", type=int, default=1)
    parser.add_argument("--steps", type=int, help="of a run, or rows of the log (200; 10000)")
    parser.add_argument("--runs", type=int, default=8, help="simulated runs")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    began = time.perf_counter()
    try:
        if min(options.runs, options.steps or 1) < 1:
            raise ValueError("expected --runs and --steps of at least 1")
        if options.mrclam is None:
            result = fit(simulated(options.runs, options.steps or 200), TRUE * OFF)
            print(table(SIMULATED, result, TRUE, "true"))
        else:
            data = mrclam(options.mrclam, options.robot)
            defaults = np.sqrt([*ODOMETRY_DENSITY, *np.diag(data.sensor.noise_cov(jnp.zeros(2)))])
            value = recorded(data, options.steps or 10_000)
            result = fit(lambda sigma: value(sigma)[0], defaults * OFF)
            print(table(RECORDED, result, defaults, "default"))
            start, end = (float(jax.jit(value)(s)[1]) for s in (defaults * OFF, result.sigma))
            print(f"NIS/dof {start:.3f} -> {end:.3f}")
    except (ValueError, OSError) as error:
        print(f"fit_noise: {error}", file=sys.stderr)
        return 2
    print(f"{time.perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
