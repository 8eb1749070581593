"""A robot on a square path maps the four walls of a room as lines."""

import jax

import jaxslam
from jaxslam.simulation.scenarios import from_start

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.square_lines()
filter = jaxslam.catalog.FILTERS["ekf"](world)
truth, log = jaxslam.simulate(world, jax.random.key(0))
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
walls = from_start(jaxslam.scenarios.square())
figure = jaxslam.plot.walls_figure(
    trace.estimate, walls, path=truth.pose, width=jaxslam.plot.COLUMN, title="square_lines"
)
