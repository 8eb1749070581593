"""Table: your own CSV files; here from a simulated robot."""

import tempfile
from functools import partial
from pathlib import Path

import jax
import numpy as np

import jaxslam

jax.config.update("jax_enable_x64", True)
world = jaxslam.scenarios.cloister(steps=150)
truth, log = jax.device_get(jaxslam.simulate(world, jax.random.key(0)))
folder, time = Path(tempfile.mkdtemp()), np.arange(150.0)
turn = "t [s],forward [m],turn [rad]"
save = partial(np.savetxt, delimiter=",", comments="", fmt="%.6g")
save(folder / "odometry.csv", np.c_[time, log.control], header=turn)
scan = log.scan
rows = np.c_[np.repeat(time, 36), scan.tag.ravel(), scan.z.reshape(-1, 2)]
save(folder / "measurements.csv", rows, header="t [s],tag,range [m],bearing [rad]")
data = jaxslam.datasets.table(folder)
filter = jaxslam.filters.EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
trace = jaxslam.run(filter, data.log, data.pose, data.pose_cov, jax.random.key(0))
figure = jaxslam.plot.map_figure(trace.estimate, title="a folder of CSV files")
