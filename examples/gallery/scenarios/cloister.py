"""A robot circles in a square cloister of 36 columns, and measures all of them in every step."""

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.cloister()
filter = jaxslam.catalog.FILTERS["ekf"](world)
truth, log = jaxslam.simulate(world, jax.random.key(0))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(
    trace.estimate, truth=truth, title="cloister: EKF with a gate of 3 σ"
)
