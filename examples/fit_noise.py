"""Fit motion and sensor noise by maximum likelihood, on simulated runs or on a recorded log.

    python examples/fit_noise.py
    python examples/fit_noise.py --mrclam FOLDER --robot 1 --steps 10000

The likelihood is that of the filter, Σ log N(innovation; 0, S) over the run.
`calibration.fit_noise` maximizes it from starts a factor 5 off, with exact gradients.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from jaxslam.calibration import NoiseFit, fit_noise
from jaxslam.core.types import Info
from jaxslam.datasets import mrclam

OFF = np.array([5.0, 0.2, 0.2, 5.0])
"""Factors from the truth, or from the reader's defaults, to the starts of the four parameters."""


TRUE = np.array([0.02, 0.01, 0.05, np.deg2rad(1.0)])
SIMULATED = ("forward [m]", "turn [rad]", "range [m]", "bearing [rad]")
POINTS = np.array([[3.0, 1.0], [-1.0, 4.0], [-3.0, -1.0], [2.0, -3.0]])


def simulated(runs: int = 8, steps: int = 200, seed: int = 0) -> Callable[[jax.Array], Info]:
    """The EKF's innovations in runs round four landmarks with noise TRUE, as a function of σ."""

    def models(sigma: Any) -> tuple[Any, Any]:
        noise = jnp.asarray(sigma) ** 2
        sensor = jaxslam.sensors.RangeBearing(jnp.diag(noise[2:]))
        return jaxslam.motion.Increment(jnp.diag(noise[:2])), sensor

    motion, sensor = models(TRUE)
    controls = np.tile([0.1, 4 * np.pi / 200], (steps, 1))
    world = jaxslam.Scenario("square", motion, sensor, landmarks=POINTS, controls=controls)
    keys = jax.random.split(jax.random.key(seed), runs)
    _, logs = jax.jit(jax.vmap(partial(jaxslam.simulate, world)))(keys)

    def info(sigma: jax.Array) -> Info:
        ekf = jaxslam.filters.EkfSlam(*models(sigma), capacity=len(POINTS), correction="joint")

        def of_run(log: Any, key: jax.Array) -> Info:
            return jaxslam.run(ekf, log, world.pose, world.pose_cov, key).info

        return jax.vmap(of_run)(logs, keys)

    return info


RECORDED = ("travel [m/√s]", "heading [rad/√s]", "range [m]", "bearing [rad]")


def recorded(data: Any, steps: int) -> Callable[[jax.Array], Info]:
    """The EKF's innovations in the first rows of a log of `datasets.mrclam`, as a function of σ."""
    log = jax.tree.map(lambda a: jnp.asarray(a[:steps]), data.log)

    def info(sigma: jax.Array) -> Info:
        motion = jaxslam.motion.Unicycle(jaxslam.motion.WhiteNoise(sigma[0], sigma[1]))
        sensor = jaxslam.sensors.RangeBearing(jnp.diag(sigma[2:] ** 2))
        ekf = jaxslam.filters.EkfSlam(motion, sensor, data.capacity, **data.filter_options)
        return jaxslam.run(ekf, log, data.pose, data.pose_cov, jax.random.key(0)).info

    return info


def table(result: NoiseFit, reference: np.ndarray, called: str) -> str:
    """One line a parameter; z is the distance from the reference in standard errors of log σ."""
    z = np.log(result.parameters / reference) / (result.error / result.parameters)
    lines = [f"{'':16}{called:>12}{'start':>12}{'fitted':>12}{'std. error':>12}{'z':>8}"]
    rows = (reference, result.start, result.parameters, result.error, z)
    for name, true, start, sigma, error, off in zip(result.names, *rows, strict=True):
        lines.append(f"{name:16}{true:12.5f}{start:12.5f}{sigma:12.5f}{error:12.5f}{off:8.2f}")
    lines.append("log-likelihood {:.1f} -> {:.1f}".format(*result.log_likelihood))
    lines.append("NIS/dof {:.3f} -> {:.3f}".format(*result.nis_per_dof))
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
            info, known, called, names = (
                simulated(options.runs, options.steps or 200),
                TRUE,
                "true",
                SIMULATED,
            )
        else:
            data = mrclam(options.mrclam, options.robot)
            noise, cov = data.motion.noise_cov, data.sensor.noise_cov(jnp.zeros(2))
            known = np.array([noise.travel, noise.turn, *np.sqrt(np.diag(cov))])
            info, called, names = recorded(data, options.steps or 10_000), "default", RECORDED
        print(table(fit_noise(info, known * OFF, names=names), known, called))
    except (ValueError, OSError) as error:
        print(f"fit_noise: {error}", file=sys.stderr)
        return 2
    print(f"{time.perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
