"""Unscented: optimistic with sigma points in (x, y, θ), and not in the right-invariant chart."""

import jax

import jaxslam
from jaxslam.catalog import FILTERS

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.circle(steps=500)
filters = {name: FILTERS[name](world) for name in ("ukf", "ukf_right")}
campaign = jaxslam.monte_carlo(world, filters, runs=40, key=jax.random.key(0))
figure = jaxslam.plot.coverage_figure(campaign)
