"""Baselines: no measurements, a known map, and SLAM in between."""

import jax

import jaxslam
from jaxslam.catalog import ALL

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.circle(steps=300)
filters = {name: ALL[name](world) for name in ("dead_reckoning", "localization", "ekf")}
campaign = jaxslam.monte_carlo(world, filters, runs=20, key=jax.random.key(0))
figure = jaxslam.plot.rmse_figure(campaign)
