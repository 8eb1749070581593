"""Localization and mapping: the two problems that Williams calls easy.

`circle` with the map known, with the path known, and without measurements, on the same draws. The
share of steps whose average NEES over the runs lies in its 95 % band, of the pose and of the map:
0.95 on average of an honest filter.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric
from jaxslam import catalog, monte_carlo, run, simulate
from jaxslam.filters import Mapping
from jaxslam.math._gaussians import mahalanobis_squared
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


def measure(quick: bool = False) -> list[Metric]:
    world, runs = circle(), 100 if quick else 1000
    filters = {name: catalog.ALL[name](world) for name in ("dead_reckoning", "localization")}
    campaign = monte_carlo(world, filters, runs, jax.random.key(0))
    print(campaign)
    share = campaign.filters["localization"].inside["pose"]
    nees, count = map_nees(world, runs)
    total, landmarks = nees.sum(axis=0), np.maximum(count.sum(axis=0), 1)
    # Landmarks of one run are independent here: a step has runs × landmarks of them.
    bands = np.array([chi2_band(2, int(many)) for many in landmarks]).T
    inside = (bands[0] <= total / landmarks) & (total / landmarks <= bands[1])
    return [
        Metric("localization: share of steps in the band of the pose", share, low=0.93),
        Metric("mapping: share of steps in the band", inside.mean(), low=0.93),
        Metric("mapping: NEES of a landmark", total[-1] / landmarks[-1], 1.9, 2.1),
    ]
