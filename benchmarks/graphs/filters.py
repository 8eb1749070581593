"""Filters, the fixed-lag smoother and the whole graph on identical draws of landmark worlds."""

import dataclasses

import jax

from benchmarks.gate import Metric, save
from jaxslam import catalog, monte_carlo, plot
from jaxslam.simulation.scenarios import circle, loop, webmap

FILTERS = ("ekf", "fej", "oc", "right_invariant", "fixed_lag", "fixed_lag_fej", "batch_map")


def measure(quick: bool = False) -> list[Metric]:
    metrics = []
    for make in (circle, loop, webmap):
        world = make(steps=100) if quick else make()
        world = dataclasses.replace(world, filter_options={"correction": "joint"})
        methods = {each: catalog.ALL[each](world) for each in FILTERS}
        runs, key = 10 if quick else 20, jax.random.key(0)
        campaign = monte_carlo(world, methods, runs, key, block=10, workers=1)
        print(f"\n{campaign}")
        if make is loop and not quick:
            save(plot.nees_figure(campaign, blocks=("pose", "heading")), "graph_filters_loop")
        nees = {each: s.measures["nees_pose"].value for each, s in campaign.filters.items()}
        name, ratio = world.name, nees["fixed_lag_fej"] / nees["fixed_lag"]
        metrics += [Metric(f"{name}: pose NEES, {each}", value) for each, value in nees.items()]
        what = f"{name}: NEES, fixed lag with / without first estimates"
        metrics.append(Metric(what, ratio, high=1.05))
    return metrics
