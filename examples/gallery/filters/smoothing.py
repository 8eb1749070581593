"""Smoothing: a window of poses gains information on the heading, unless Jacobians stay fixed."""

import jax

import jaxslam
from jaxslam.catalog import SMOOTHERS

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.circle(steps=1000)
filters = {name: make(world) for name, make in SMOOTHERS.items()}
campaign = jaxslam.monte_carlo(world, filters, runs=16, key=jax.random.key(0))
figure = jaxslam.plot.nees_figure(campaign, blocks=("pose", "heading"))
