"""A robot circles inside a ring of 20 landmarks, and sees those between 1 and 5 m."""

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.circle(steps=240)
filter = jaxslam.catalog.FILTERS["ekf"](world)
truth, log = jaxslam.simulate(world, jax.random.key(0))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(trace.estimate, truth=truth, title="circle: one round of the EKF")
