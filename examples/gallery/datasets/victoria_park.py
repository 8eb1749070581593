"""Victoria Park: a truck among trees; the file is part of GTSAM."""

import gtsam
import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
data = jaxslam.datasets.victoria_park(gtsam.findExampleDataFile("victoria_park.txt"))
chart = jaxslam.charts.RightInvariant()
filter = jaxslam.filters.EkfSlam(
    data.motion, data.sensor, data.capacity, chart=chart, **data.filter_options
)
trace = jaxslam.run(filter, data.log, data.pose, data.pose_cov, jax.random.key(0))
title = "Victoria Park: right-invariant EKF"
figure = jaxslam.plot.map_figure(trace.estimate, title=title)
