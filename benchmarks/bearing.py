"""Bearings alone: a prior on the range, or on its inverse (Solà 2.3.5, 2.3.6).

    python -m benchmarks.bearing [--runs 100]

`cloister` and `circle` with a camera instead of their sensors: the same worlds, one bearing of 1° a
landmark. Filters on the same draws:

- `naive`: landmarks (x, y) from a Gaussian prior of the range, an EKF;
- `inverse_depth`: rays from the first sighting with the customary prior of the inverse distance,
  1/2 ± 1/4 of 1/d_min, d_min = 1 m, an EKF;
- `rays_invariant`: the same in the right-invariant chart of rays, with sigma points and rays that
  become points at a linearity index of 0.1;
- `rays_matched`: that with the prior 1/4 ± 1/4 1/m, as the inverse distances of these worlds are:
  0.31 ± 0.24 in `cloister`, 0.2 at the first sight of most in `circle`. Prior and world must agree:
  36 landmarks that are twice as far as the prior expects are 36 wrong votes on one scale.

The yardstick is 3, the pose NEES of an honest filter; the contract is its 95 % band over so many
runs and 30 % more, for the customary prior. (Jacobians at the truth make no ideal filter of the
naive one: its estimate starts metres off, where they are not those of its own innovations.)
"""

import dataclasses
from functools import partial

import jax
import numpy as np

from benchmarks.gate import Metric, alone
from jaxslam import monte_carlo, sensors
from jaxslam.charts import RightInvariant
from jaxslam.filters import EkfSlam
from jaxslam.linearize import Unscented
from jaxslam.math.stats import chi2_band
from jaxslam.simulation.scenarios import circle, cloister

SIGMA = np.deg2rad(1.0)
# The range 5 m ± 2.5 m, and the inverse distance from d_min = 1 m: both hold all distances that
# occur, 1 to 7 m.
RANGE = (np.array([5.0]), np.array([[2.5**2]]))
MIN_DISTANCE = 1.0
MATCHED = ((0.25,), ((0.25**2,),))
TO_POINT = 0.1
ROWS = ("nees_pose", "nees_heading", "nis_per_dof", "rmse_position", "rmse_landmarks")


def worlds():
    cov = np.array([[SIGMA**2]])
    camera = sensors.BearingOnly(cov, free=RANGE)
    rays = sensors.BearingInverseDepth(cov, min_distance=MIN_DISTANCE)
    to_points = sensors.BearingInverseDepth(cov, min_distance=MIN_DISTANCE, to_point=TO_POINT)
    matched = sensors.BearingInverseDepth(cov, inverse_distance=MATCHED, to_point=TO_POINT)
    for world in (cloister(), circle()):
        scenario = dataclasses.replace(
            world, name=f"{world.name}, bearings", sensor=camera, filter_options={}, published={}
        )
        ekf = partial(
            EkfSlam, scenario.motion, capacity=len(scenario.landmarks), correction="joint"
        )
        better = {"chart": RightInvariant(rays=True), "linearize": Unscented()}
        yield (
            scenario,
            {
                "naive": ekf(camera),
                "inverse_depth": ekf(rays),
                "rays_invariant": ekf(to_points, **better),
                "rays_matched": ekf(matched, **better),
            },
        )


def measure(runs=100):
    metrics = []
    for scenario, filters in worlds():
        campaign = monte_carlo(scenario, filters, runs, jax.random.key(0))
        print(f"\n{scenario.name}: {campaign.runs} runs × {campaign.steps} steps")
        print(f"{'':18}" + "".join(f"{name:>24}" for name in filters))
        print(f"{'verdict':18}" + "".join(f"{s.verdict:>24}" for s in campaign.filters.values()))
        for row in ROWS:
            cells = []
            for summary in campaign.filters.values():
                m = summary.measures.get(row)
                cells.append("-" if m is None else f"{m.value:.4g} [{m.low:.3g}, {m.high:.3g}]")
            print(f"{row:18}" + "".join(f"{cell:>24}" for cell in cells))
        for row in ("divergent", "not_finite", "singular"):
            counts = (str(s.counts.get(row, 0)) for s in campaign.filters.values())
            print(f"{row:18}" + "".join(f"{cell:>24}" for cell in counts))
        nees = campaign.filters["rays_invariant"].measures["nees_pose"].value
        lost = campaign.filters["naive"].counts["divergent"] / runs
        high = 1.3 * chi2_band(3, runs)[1]
        metrics.append(Metric(f"{scenario.name}: rays_invariant, pose NEES", nees, high=high))
        metrics.append(Metric(f"{scenario.name}: naive, share divergent", lost, low=0.1))
    return metrics


if __name__ == "__main__":
    raise SystemExit(alone("bearing", measure, runs={"type": int, "default": 100}))
