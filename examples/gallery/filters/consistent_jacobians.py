"""Consistent Jacobians: FEJ and OC gain no information on a rotation of the frame."""

import jax

import jaxslam
from jaxslam.catalog import FILTERS

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.loop(steps=200)
filters = {name: FILTERS[name](world, watch=True) for name in ("ekf", "fej", "oc")}
campaign = jaxslam.monte_carlo(world, filters, runs=16, key=jax.random.key(0))
figure = jaxslam.plot.gained_figure(campaign)
