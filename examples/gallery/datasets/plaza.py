"""Plaza: a lawn mower measures its distance from four beacons, one at a time."""

import gtsam
import jax

import jaxslam
from jaxslam.datasets import evaluate
from jaxslam.filters import StoredMeasurements

jax.config.update("jax_enable_x64", True)
data = jaxslam.datasets.plaza(gtsam.findExampleDataFile("Plaza1_.mat"))
stored = StoredMeasurements(capacity=40, spacing=2.0)
filter = jaxslam.filters.DelayedSlam(data.motion, data.sensor, data.capacity, stored=stored)
trace = jaxslam.run(filter, data.log, data.pose, data.pose_cov, jax.random.key(0))
found = evaluate(data, trace.estimate, jax.tree.map(lambda leaf: leaf[-1], trace.estimate))
figure = jaxslam.plot.map_figure(
    trace.estimate, true_points=found.points, true_path=found.path, title="Plaza1: delayed_slam"
)
