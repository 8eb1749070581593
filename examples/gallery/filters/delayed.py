"""Delayed: ranges only; a beacon enters the map when one of two intersections is rejected."""

import jax
import numpy as np

import jaxslam

jax.config.update("jax_enable_x64", True)
motion = jaxslam.motion.Increment(np.diag([0.005, 0.003]) ** 2)
radio = jaxslam.sensors.RangeOnly([[0.1**2]])
world = jaxslam.Scenario(
    name="beacons",
    motion=motion,
    sensor=radio,
    landmarks=np.array([[4.0, 5.0], [-3.0, 4.0], [5.0, -1.0]]),
    controls=np.tile([0.2, 0.08], (120, 1)),
)
truth, log = jaxslam.simulate(world, jax.random.key(2))
filter = jaxslam.filters.DelayedSlam(motion, radio, capacity=3)
trace = jaxslam.run(filter, log, world.pose, world.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(trace.estimate, truth=truth, title="delayed_slam: ranges alone")
