"""Whole runs of `cloister` with clutter and a noisy odometry."""

import dataclasses

import jax
import numpy as np

from benchmarks.association import rules
from jaxslam import motion
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.filters import EkfSlam
from jaxslam.life import Existence
from jaxslam.simulation.scenarios import BetweenRanges, cloister
from jaxslam.simulation.spurious import Spurious

RUNS = 32
REACH = 4.0
CAPACITY = 60
GATES = 0.99, 0.9999
METHODS = rules(*GATES, budget=500)
ROWS = ("precision", "recall", "false_landmarks", "nees_pose", "rmse_position")


def measure():
    """{method: {measure: value}} with the share of divergent runs; `known` believes the tags."""
    scenario = dataclasses.replace(
        cloister(),
        motion=motion.Increment(np.diag([0.03, 0.06]) ** 2),  # three times that of the scenario
        visible=BetweenRanges(0.0, REACH),
        places=12,
        spurious=Spurious(clutter=1.0, missed=0.05, reach=REACH),
    )
    parts = scenario.motion, scenario.sensor, CAPACITY
    life = Existence(BetweenRanges(0.0, 0.8 * REACH), patience=20)
    filters = {"known": EkfSlam(*parts)}
    for name, method in METHODS.items():
        filters[name] = EkfSlam(*parts, associate=method, life=life)
    campaign = monte_carlo(scenario, filters, RUNS, jax.random.key(0))
    out = {}
    for name, summary in campaign.filters.items():
        out[name] = {row: summary.measures[row].value for row in ROWS if row in summary.measures}
        lost = summary.counts["divergent"] + summary.counts["not_finite"]
        out[name]["divergent"] = lost / RUNS
    return out
