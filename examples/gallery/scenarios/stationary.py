"""A robot at rest measures one landmark: a filter that becomes certain of its heading is wrong."""

import jax

import jaxslam
from jaxslam.catalog import FILTERS

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.stationary(steps=200)
filters = {name: FILTERS[name](world, watch=True) for name in ("ekf", "fej", "right_invariant")}
campaign = jaxslam.monte_carlo(world, filters, runs=32, key=jax.random.key(0))
figure = jaxslam.plot.gained_figure(campaign)
