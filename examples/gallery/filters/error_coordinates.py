"""Error coordinates: the heading leaves its band in (x, y, θ), and not in invariant coordinates."""

import jax

import jaxslam
from jaxslam.catalog import FILTERS

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.circle(steps=500)
filters = {name: FILTERS[name](world) for name in ("ekf", "right_invariant")}
campaign = jaxslam.monte_carlo(world, filters, runs=40, key=jax.random.key(0))
figure = jaxslam.plot.nees_figure(campaign, blocks=("heading",))
