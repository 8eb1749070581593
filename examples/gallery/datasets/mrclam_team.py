"""MRCLAM, three robots that measure each other: map and path of the first, paths of the others."""

import sys
from functools import partial

import jax

import jaxslam

jax.config.update("jax_enable_x64", True)
data = jaxslam.datasets.mrclam_team(sys.argv[1])
log = jax.tree.map(lambda leaf: leaf[:60_000], data.log)
filter = jaxslam.filters.TeamSlam(data.robots, data.capacity, **data.filter_options)
probe = partial(jaxslam.team.poses, robots=3)
trace = jaxslam.run(filter, log, data.pose, data.pose_cov, jax.random.key(0), probe=probe)
figure = jaxslam.plot.map_figure(trace.estimate, title=f"{data.name}, 60,000 rows")
poses, _, there = trace.probe
for robot, color in ((1, "tab:green"), (2, "tab:purple")):
    figure.axes[0].plot(*poses[there[:, robot], robot, :2].T, lw=0.6, color=color)
