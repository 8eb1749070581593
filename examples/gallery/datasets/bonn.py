"""Bonn: 331 steps of simulated course data; the folder of the data set is the argument."""

import sys

import jax

import jaxslam
from jaxslam.datasets import evaluate

jax.config.update("jax_enable_x64", True)
data = jaxslam.datasets.bonn(sys.argv[1])
filter = jaxslam.filters.EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
trace = jaxslam.run(filter, data.log, data.pose, data.pose_cov, jax.random.key(0))
found = evaluate(data, trace.estimate, jax.tree.map(lambda leaf: leaf[-1], trace.estimate))
figure = jaxslam.plot.map_figure(
    trace.estimate, true_points=found.points, names=data.tags, title=data.name
)
