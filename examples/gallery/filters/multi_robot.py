"""Several robots: two robots that measure each other share one map."""

import jax
import numpy as np

import jaxslam
from jaxslam import team

jax.config.update("jax_enable_x64", True)
motion = jaxslam.motion.Increment(np.diag([0.02, 0.02]) ** 2)
eye = jaxslam.sensors.RangeBearing(np.diag([0.1, np.deg2rad(2.0)]) ** 2)
sees = jaxslam.sensors.Suite(((eye, 6), jaxslam.sensors.Part(eye, 1, sees="robots")))
start = (2.0, -1.0, 0.5), np.diag([0.05, 0.05, 0.02]) ** 2
crew = [team.Robot(motion, sees), team.Robot(motion, sees, start=start)]
posts = [[4.0, 5.0], [-3.0, 4.0], [5.0, -1.0], [0.0, 8.0], [-2.0, -1.0], [3.0, 1.5]]
world = jaxslam.TeamWorld(crew, posts, np.tile([0.2, 0.08, 0.2, 0.05], (40, 1)))
truth, log = jaxslam.simulate(world, jax.random.key(1))
found = {}
for robot in (0, 1):
    filter = jaxslam.filters.TeamSlam(crew, capacity=6, correction="joint", report=robot)
    start = world.pose, world.pose_cov, jax.random.key(0)
    found[f"robot {robot + 1}"] = jaxslam.run(filter, log, *start).estimate
first = found.pop("robot 1")
figure = jaxslam.plot.map_figure(first, truth=truth, others=found, title="team_slam: two robots")
