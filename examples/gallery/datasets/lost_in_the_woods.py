"""Lost in the woods: a real robot among 17 posts, whose EKF turns away from the truth."""

import runpy
import sys
import tempfile
from pathlib import Path

import jax

import jaxslam
from jaxslam.datasets import evaluate
from jaxslam.filters import EkfSlam

jax.config.update("jax_enable_x64", True)
example = runpy.run_path(str(Path(__file__).parents[2] / "lost_in_the_woods.py"))
folder = example["write_tables"](f"{sys.argv[1]}/dataset2.mat", tempfile.mkdtemp(), spacing=0.0)
data = jaxslam.datasets.table(folder)
traces = {}
for name, chart in jaxslam.charts.REGISTRY.items():
    filter = EkfSlam(data.motion, data.sensor, data.capacity, chart=chart(), **data.filter_options)
    traces[name] = jaxslam.run(filter, data.log, data.pose, data.pose_cov, jax.random.key(0))
estimate = traces["euclidean"].estimate
found = evaluate(data, estimate, jax.tree.map(lambda leaf: leaf[-1], estimate))
figure = jaxslam.plot.map_figure(
    estimate,
    true_points=found.points,
    others={"right-invariant": traces["right_invariant"].estimate},
    title="Lost in the woods: EKF with ellipses",
)
