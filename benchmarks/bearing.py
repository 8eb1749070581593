"""Bearings alone: a prior on the range, or on its inverse (Solà 2.3.5, 2.3.6).

    python -m benchmarks.bearing [--runs 100]

`cloister` and `circle` with a camera instead of their sensors: the same worlds, one bearing of 1° a
landmark. Filters on the same draws: `naive`, landmarks (x, y) from a Gaussian prior of the range;
`inverse_depth`, rays from the first sighting with a Gaussian prior of the inverse distance. The
yardstick is 3, the pose NEES of an honest filter. (Jacobians at the truth make no ideal filter of
the naive one: its estimate starts metres off, where they are not those of its own innovations.)
"""

import argparse
import dataclasses

import jax
import numpy as np

from benchmarks.gate import Metric, report
from jaxslam import monte_carlo, sensors
from jaxslam.filters import ekf_slam
from jaxslam.scenarios import circle, cloister

SIGMA = np.deg2rad(1.0)
# The range 5 m ± 2.5 m, and the inverse distance from d_min = 1 m: both hold all distances that
# occur, 1 to 7 m.
RANGE = (np.array([5.0]), np.array([[2.5**2]]))
MIN_DISTANCE = 1.0
ROWS = ("nees_pose", "nees_heading", "nis_per_dof", "rmse_position", "rmse_landmarks")


def worlds():
    cov = np.array([[SIGMA**2]])
    camera = sensors.bearing_only(cov, free=RANGE)
    rays = sensors.bearing_inverse_depth(cov, min_distance=MIN_DISTANCE)
    for world in (cloister(), circle()):
        scenario = dataclasses.replace(
            world, name=f"{world.name}, bearings", sensor=camera, filter_options={}, published={}
        )
        parts = scenario.motion, camera, len(scenario.landmarks)
        yield (
            scenario,
            {
                "naive": ekf_slam(*parts, update="joint"),
                "inverse_depth": ekf_slam(scenario.motion, rays, parts[2], update="joint"),
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
        rays, naive = (campaign.filters[name] for name in ("inverse_depth", "naive"))
        nees, lost = rays.measures["nees_pose"].low, naive.counts["divergent"] / runs
        metrics.append(Metric(f"{scenario.name}: inverse depth, pose NEES", nees, high=3.9))
        metrics.append(Metric(f"{scenario.name}: naive, share divergent", lost, low=0.1))
    return metrics


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bearing")
    parser.add_argument("--runs", type=int, default=100)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    metrics = measure(options.runs)
    print()
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
