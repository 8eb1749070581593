"""Filters, the fixed-lag smoother and the whole graph on identical draws of landmark worlds."""

import dataclasses

import jax

from jaxslam import catalog, monte_carlo
from jaxslam.simulation.scenarios import circle, loop, webmap
from jaxslam.smoothing import batch_map

WORLDS = {"circle": circle, "loop": loop, "webmap": webmap}
FILTERS = ("ekf", "fej", "oc", "right_invariant", "fixed_lag", "fixed_lag_fej")


def campaigns(runs=50, steps=None, names=tuple(WORLDS)):
    """{world: campaign} of the filters and the batch solution, which is the graph of the log."""
    found = {}
    for name in names:
        world = WORLDS[name]() if steps is None else WORLDS[name](steps=steps)
        world = dataclasses.replace(world, filter_options={"update": "joint"})
        arguments = world.motion, world.sensor, len(world.landmarks), world.pose, world.pose_cov
        methods = {each: catalog.ALL[each](world) for each in FILTERS}
        methods["graph"] = lambda truth, arguments=arguments: batch_map(*arguments)
        found[name] = monte_carlo(world, methods, runs, jax.random.key(0), block=10, workers=1)
    return found
