"""Filters, the fixed-lag smoother and the whole graph on identical draws of landmark worlds."""

import dataclasses

import jax

from jaxslam import catalog, monte_carlo
from jaxslam.simulation.scenarios import circle, loop, webmap

WORLDS = {"circle": circle, "loop": loop, "webmap": webmap}
FILTERS = ("ekf", "fej", "oc", "right_invariant", "fixed_lag", "fixed_lag_fej", "batch_map")


def campaigns(runs=20, steps=None, names=tuple(WORLDS)):
    """{world: campaign} of the filters and `batch_map`, the graph of the log."""
    found = {}
    for name in names:
        world = WORLDS[name]() if steps is None else WORLDS[name](steps=steps)
        world = dataclasses.replace(world, filter_options={"correction": "joint"})
        methods = {each: catalog.ALL[each](world) for each in FILTERS}
        found[name] = monte_carlo(world, methods, runs, jax.random.key(0), block=10, workers=1)
    return found
