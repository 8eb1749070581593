"""Localization and mapping: the two problems that Williams calls easy.

    python -m benchmarks.baselines [--runs 1000]

`circle` with the map known, with the path known, and without measurements, on the same draws. The
share of steps whose average NEES over the runs lies in its 95 % band, of the pose and of the map:
0.95 on average of an honest filter.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, alone
from jaxslam import catalog, monte_carlo, run, simulate
from jaxslam.filters import Mapping
from jaxslam.math.gaussians import mahalanobis_squared
from jaxslam.math.stats import chi2_band
from jaxslam.simulation.scenarios import circle


def map_nees(world, runs):
    """(runs, T) each: NEES of all landmarks of `mapping` together, and how many these are."""
    filter = Mapping(world.sensor, len(world.landmarks))

    def one(key):
        truth, log = simulate(world, key)
        start = jnp.zeros(3), jnp.zeros((3, 3)), key
        estimate = run(filter, log._replace(control=truth.pose), *start).estimate
        off = truth.landmarks[jnp.maximum(estimate.tag, 0)] - estimate.points
        nees, regular = jax.vmap(jax.vmap(mahalanobis_squared))(off, estimate.point_covs)
        there = regular & estimate.alive
        return jnp.where(there, nees, 0.0).sum(axis=1), there.sum(axis=1)

    batched = jax.jit(partial(jax.lax.map, one, batch_size=20))
    nees, count = batched(jax.random.split(jax.random.key(1), runs))
    return np.asarray(nees), np.asarray(count)


def measure(runs=1000):
    world = circle()
    filters = {name: catalog.BASELINES[name](world) for name in ("dead_reckoning", "localization")}
    campaign = monte_carlo(world, filters, runs, jax.random.key(0))
    metrics = []
    for name, summary in campaign.filters.items():
        print(f"{name}: {summary.verdict}")
        for row in ("nees_pose", "rmse_position", "rmse_heading_deg"):
            m = summary.measures[row]
            print(f"  {row:18}{m.value:10.4g} [{m.low:.4g}, {m.high:.4g}]")
    share = campaign.filters["localization"].inside["pose"]
    metrics.append(Metric("localization: share of steps in the band of the pose", share, low=0.93))
    nees, count = map_nees(world, runs)
    total, landmarks = nees.sum(axis=0), count.sum(axis=0)
    # Landmarks of one run are independent here: a step has runs × landmarks of them.
    inside = []
    for value, many in zip(total, landmarks, strict=True):
        low, high = chi2_band(2, max(int(many), 1))
        inside.append(low <= value / max(many, 1) <= high)
    print(f"mapping: NEES of a landmark {total.sum() / landmarks.sum():.4f} (2)")
    metrics.append(Metric("mapping: share of steps in the band", float(np.mean(inside)), low=0.93))
    metrics.append(Metric("mapping: NEES of a landmark", total[-1] / landmarks[-1], 1.9, 2.1))
    return metrics


if __name__ == "__main__":
    raise SystemExit(alone("baselines", measure, runs={"type": int, "default": 1000}))
