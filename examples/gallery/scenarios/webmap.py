"""A steered car drives a loop of 340 m, and sees the landmarks ahead of it up to 30 m."""

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.webmap(loops=1)
filter = jaxslam.catalog.FILTERS["ekf"](world)
truth, log = jaxslam.simulate(world, jax.random.key(0))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(trace.estimate, truth=truth, title="webmap: one loop of the EKF")
