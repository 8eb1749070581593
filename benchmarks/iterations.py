"""When iterating a correction helps: the EKF with 1, 3 and 10 iterations on the same draws.

An iterated correction is Gauss–Newton for the pose and landmarks at one scan (Bell & Cathey 1993).
It helps where the Jacobian at the prior is far from that at the answer: a strongly nonlinear
measurement, with an R that is small beside H P Hᵀ. It cannot help where the inconsistency comes
from Jacobians of one landmark at different estimates, by which the filter gains information on
directions that nobody observes (`circle`): it takes them at estimates that differ by more.

- `circle` and `cloister`, as they are;
- a precise sensor, 1 cm and 0.1°, of a robot that knows its start to 1 m and 0.5 rad, in a known
  map, and in a map that is estimated, where the start stays as vague as it was;
- bearings with a prior of the range, 5 m ± 2.5 m, or of the inverse range, in `cloister`.
"""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial

import jax
import numpy as np

from benchmarks.bearing import worlds as bearing_worlds
from benchmarks.gate import Metric, show
from jaxslam import Scenario, monte_carlo, sensors
from jaxslam.catalog import FILTERS
from jaxslam.core.protocols import Filter
from jaxslam.filters import Localization
from jaxslam.simulation.scenarios import circle, cloister

ITERATIONS = 1, 3, 10
VAGUE = np.diag([1.0, 1.0, 0.5]) ** 2
PRECISE = sensors.RangeBearing(np.diag([0.01, np.deg2rad(0.1)]) ** 2)
KNOWN_MAP = "known map, vague start"


def cases() -> Iterator[tuple[str, Scenario, Callable[..., Filter]]]:
    """Name, world, and the filter by its number of iterations."""
    for world in (circle(), cloister()):
        yield world.name, world, partial(FILTERS["ekf"], world)
    vague = dataclasses.replace(
        cloister(50), name="vague start", sensor=PRECISE, pose_cov=VAGUE, filter_options={}
    )
    known = partial(Localization, vague.motion, vague.sensor, vague.landmarks, correction="joint")
    yield KNOWN_MAP, vague, known
    yield "SLAM, vague start", vague, partial(FILTERS["ekf"], vague, correction="joint")
    world, filters = next(bearing_worlds())
    for name, prior in (("naive", "range"), ("inverse_depth", "inverse range")):
        ekf = filters[name]
        yield f"bearings, prior of {prior}", world, partial(dataclasses.replace, ekf)


def measure(quick: bool = False) -> list[Metric]:
    runs, metrics, rmse = 20 if quick else 100, [], {}
    for name, world, make in cases():
        rows = {}
        filters = {str(n): make(iterations=n) for n in ITERATIONS}
        campaign = monte_carlo(world, filters, runs, jax.random.key(0), progress=False, bound=False)
        for n, summary in campaign.filters.items():
            nees, rmse[name, n] = (
                summary.measures[measure].value for measure in ("nees_pose", "rmse_position")
            )
            rows[n] = {"pose NEES": nees, "position RMSE [m]": rmse[name, n]}
            rows[n] |= {"verdict": summary.verdict}
            what = f"{name}, {n} iteration{'s' * (n != '1')}"
            metrics.append(Metric(f"{what}: pose NEES", nees))
            metrics.append(Metric(f"{what}: position RMSE [m]", rmse[name, n]))
        show(f"{name}, by the number of iterations", rows)
    ratio = rmse[KNOWN_MAP, "10"] / rmse[KNOWN_MAP, "1"]
    metrics.append(Metric(f"{KNOWN_MAP}: RMSE of 10 iterations / 1", ratio, high=1.0))
    return metrics
