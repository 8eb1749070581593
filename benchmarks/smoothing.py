"""What hindsight is worth: the EKF, its smoother and the batch solution of the same logs.

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
"""

import dataclasses

import jax

from benchmarks.gate import Metric
from jaxslam import monte_carlo
from jaxslam.filters import EkfSlam
from jaxslam.graphs.smoothing import BatchMap, Smoother
from jaxslam.simulation.scenarios import circle, cloister

TOL = 1e-6


def measure(quick: bool = False) -> list[Metric]:
    metrics, runs = [], 10 if quick else 100
    for make in (circle, cloister):
        world = dataclasses.replace(make(), filter_options={"correction": "joint"})
        capacity = len(world.landmarks)
        arguments = world.motion, world.sensor, capacity, world.pose, world.pose_cov
        methods = {
            "ekf": EkfSlam(world.motion, world.sensor, capacity, correction="joint"),
            "smooth": lambda truth: Smoother(*arguments),
            "batch": lambda truth: BatchMap(*arguments),
        }
        # A small block: a smoother holds the gains of all steps.
        campaign = monte_carlo(world, methods, runs, jax.random.key(0), block=10, workers=1)
        print(campaign, flush=True)
        path, points = (
            {name: s.measures[row].value for name, s in campaign.filters.items()}
            for row in ("rmse_position", "rmse_landmarks")
        )
        name, batch = world.name, campaign.filters["batch"]
        of_map = points["smooth"] / points["ekf"] - 1
        metrics += [
            Metric(f"{name}: path, smooth / ekf", path["smooth"] / path["ekf"]),
            Metric(f"{name}: path, batch / ekf", path["batch"] / path["ekf"], high=1.05),
            Metric(f"{name}: path, batch / smooth", path["batch"] / path["smooth"], high=1.05),
            Metric(f"{name}: map, smooth / ekf - 1", of_map, -TOL, TOL),
            Metric(f"{name}: map, batch / ekf", points["batch"] / points["ekf"], high=1.05),
            Metric(f"{name}: batches not converged", batch.counts["exhausted"], high=0),
        ]
    return metrics
