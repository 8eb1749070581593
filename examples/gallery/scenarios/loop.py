"""A robot drives round and round among 20 random landmarks."""

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.loop(steps=500)
filter = jaxslam.catalog.FILTERS["ekf"](world)
truth, log = jaxslam.simulate(world, jax.random.key(0))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(trace.estimate, truth=truth, title="loop: two rounds of the EKF")
