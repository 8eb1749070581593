"""The cloister with 3° of noise, where the standard EKF diverges; here the right-invariant EKF."""

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.cloister_noisy()
filter = jaxslam.catalog.FILTERS["right_invariant"](world)
truth, log = jaxslam.simulate(world, jax.random.key(2))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(
    trace.estimate, truth=truth, title="cloister_noisy: right-invariant EKF"
)
