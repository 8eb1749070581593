"""What hindsight is worth: the EKF, its smoother and the batch solution of the same logs.

    python -m benchmarks.smoothing [--runs 100] [--steps 500] [--park]

`circle` and `cloister`, the same draws for all three, association known and nothing gated:

- `ekf`: `EkfSlam(correction="joint")`, each pose by what came before it;
- `smooth`: `smoothing.Smoother`, each pose by the whole log, in the EKF's own linear system;
- `batch`: `smoothing.BatchMap`, the maximum a posteriori path and map of the models themselves.

RMSE of the path and of the final map, and the NEES of pose and landmarks, 3 and 2 for an honest
one. The smoother and the EKF end at the same pose and map, so they have one map RMSE; what the
batch has less of it is the price of linearizing once, at estimates that were not yet good.

The gates: on path and map the batch is no more than 5 % worse than EKF and smoother; the map of
smoother and EKF is one; all batches converge. There is none on the smoother's path: it is as good
as the linearization, and where the EKF ends up turned against the truth, the smoother turns the
whole path with it, down to a start that the EKF still knew.

`--park`: Victoria Park alone, 6,968 poses and 151 landmarks, from the plain EKF's result, against
GTSAM's optimum of the same file, whose motion noise is in the frame of the later pose (see
`benchmarks.victoria_park`): the same but for millimetres.
"""

import argparse
import dataclasses
import time

import jax
import numpy as np

from benchmarks.gate import Metric, report
from jaxslam import datasets, monte_carlo
from jaxslam.filters import EkfSlam
from jaxslam.graphs import Ending
from jaxslam.graphs.smoothing import BatchMap, Smoother
from jaxslam.simulation.scenarios import circle, cloister

TOL = 1e-6
ROWS = (
    "rmse_position",
    "rmse_heading_deg",
    "rmse_landmarks",
    "nees_pose",
    "nees_position",
    "nees_heading",
    "nees_landmarks",
    "coverage_95_pose",
)


def measure(runs=100, steps=None):
    metrics = []
    for make in (circle, cloister):
        world = make() if steps is None else make(steps)
        world = dataclasses.replace(world, filter_options={"correction": "joint"})
        capacity = len(world.landmarks)
        arguments = world.motion, world.sensor, capacity, world.pose, world.pose_cov
        methods = {
            "ekf": EkfSlam(world.motion, world.sensor, capacity, correction="joint"),
            "smooth": lambda truth: Smoother(*arguments),
            "batch": lambda truth: BatchMap(*arguments),
        }
        # A small block: a smoother holds the gains of all steps.
        campaign = monte_carlo(world, methods, runs, jax.random.key(0), block=10, workers=1)
        print(f"\n{world.name}: {campaign.runs} runs × {campaign.steps} steps")
        print(f"{'':18}" + "".join(f"{name:>24}" for name in methods))
        print(f"{'verdict':18}" + "".join(f"{s.verdict:>24}" for s in campaign.filters.values()))
        for row in ROWS:
            cells = []
            for summary in campaign.filters.values():
                m = summary.measures.get(row)
                cells.append("-" if m is None else f"{m.value:.4g} [{m.low:.3g}, {m.high:.3g}]")
            print(f"{row:18}" + "".join(f"{cell:>24}" for cell in cells))
        for row in ("divergent", "not_finite", "exhausted"):
            counts = (str(s.counts.get(row, 0)) for s in campaign.filters.values())
            print(f"{row:18}" + "".join(f"{count:>24}" for count in counts))
        path, points = (
            {name: s.measures[row].value for name, s in campaign.filters.items()}
            for row in ("rmse_position", "rmse_landmarks")
        )
        name, batch = world.name, campaign.filters["batch"]
        metrics += [
            Metric(f"{name}: path, smooth / ekf", path["smooth"] / path["ekf"]),
            Metric(f"{name}: path, batch / ekf", path["batch"] / path["ekf"], high=1.05),
            Metric(f"{name}: path, batch / smooth", path["batch"] / path["smooth"], high=1.05),
            Metric(
                f"{name}: map, smooth / ekf - 1", points["smooth"] / points["ekf"] - 1, -TOL, TOL
            ),
            Metric(f"{name}: map, batch / ekf", points["batch"] / points["ekf"], high=1.05),
            Metric(f"{name}: batches not converged", batch.counts["exhausted"], high=0),
        ]
    return metrics


def park():
    """The batch of Victoria Park beside GTSAM's."""
    import gtsam

    from benchmarks.victoria_park import Solution, compare, run_batch

    data = datasets.victoria_park(gtsam.findExampleDataFile("victoria_park.txt"))
    method = BatchMap(data.motion, data.sensor, data.capacity, data.pose, data.pose_cov)
    go = jax.jit(method).lower(data.log, jax.random.key(0)).compile()
    began = time.perf_counter()
    trace = jax.block_until_ready(go(data.log, jax.random.key(0)))
    seconds, solved = time.perf_counter() - began, trace.final
    order = np.argsort(np.asarray(solved.joint.tag))
    found = Solution(np.asarray(trace.estimate.pose), np.asarray(solved.joint.landmarks)[order])
    theirs = run_batch(data, found)
    taken = int(solved.iterations)
    print(f"{data.name}: {taken} steps in {seconds:.1f} s, the EKF and its smoother included")
    print("cost after each: " + " ".join(f"{c:.3f}" for c in np.asarray(solved.costs)[:taken]))
    print(f"GTSAM from there: {theirs.error_before:.3f} -> {theirs.error_after:.3f}")
    apart = compare(found, theirs.solution)
    return [
        Metric("batch converged", float(solved.ending == Ending.CONVERGED), low=1.0),
        Metric("map from GTSAM's [m]", apart["map RMSE [m]"], high=0.003),
        Metric("path from GTSAM's [m]", apart["path RMSE [m]"], high=0.003),
    ]


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.smoothing")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--steps", type=int, help="of both worlds; default 2500 and 200")
    parser.add_argument("--park", action="store_true", help="Victoria Park alone")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    metrics = park() if options.park else measure(options.runs, options.steps)
    print()
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
