"""The loop with ranges of 10 % and bearings of 10°, and the EKF with consistent Jacobians."""

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.loop_bearing(steps=500)
filter = jaxslam.catalog.FILTERS["oc"](world)
truth, log = jaxslam.simulate(world, jax.random.key(0))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(trace.estimate, truth=truth, title="loop_bearing: OC-EKF")
