"""Walls as landmarks: a robot maps the lines of an office, along the corridor and into rooms."""

import jax

import jaxslam
from jaxslam.simulation.scenarios import from_start

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.office_lines()
filter = jaxslam.catalog.FILTERS["ekf"](world)
truth, log = jaxslam.simulate(world, jax.random.key(0))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
walls = from_start(jaxslam.scenarios.office())
figure = jaxslam.plot.walls_figure(
    trace.estimate, walls, path=truth.pose, title="office_lines: walls mapped by the EKF"
)
