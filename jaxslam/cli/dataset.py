"""`jaxslam run`: EKF-SLAM on recorded data."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import report, se2
from jaxslam.cli.asking import Progress, pick
from jaxslam.consistency import align_map
from jaxslam.datasets import READERS
from jaxslam.filters.ekf_slam import ekf_slam
from jaxslam.linalg import is_positive_definite
from jaxslam.run import run
from jaxslam.types import Status


def run_dataset(options: argparse.Namespace, command: str) -> int:
    """Run EKF-SLAM over the data set, print its summary, write its files; exit status."""
    data = pick("dataset", options.dataset, READERS)(options.path, options.robot)
    report.check_writable(options.out)
    ekf = ekf_slam(data.motion, data.sensor, data.capacity, **data.filter_options)
    with Progress(f"{data.name}, {data.steps:,} steps") as progress:
        progress.say("running …")
        began = time.perf_counter()
        # Value checks happen on the host here; the log then enters the run in the chosen dtype.
        trace = run(
            ekf,
            jax.tree.map(jnp.asarray, data.log),
            data.pose,
            data.pose_cov,
            jax.random.key(0),
            probe=lambda joint: is_positive_definite(joint.cov),
        )
        jax.block_until_ready(trace)
    seconds = time.perf_counter() - began
    last = jax.tree.map(lambda leaf: leaf[-1], trace.estimate)
    nis = jnp.where(trace.info.status == Status.FUSED, trace.info.nis, 0.0).sum()
    summary: dict[str, Any] = {
        "dataset": data.name,
        "source": data.source,
        "command": command,
        "dtype": str(last.pose.dtype),
        "steps": data.steps,
        "measurements": data.measurements,
        "landmarks": int(last.alive.sum()),
        "status": {
            s.name.lower(): int(trace.info.tally(s).sum()) for s in Status if s != Status.EMPTY
        },
        "dropped by the reader": data.dropped,
        "corrections to the data": list(data.corrections),
        "NIS / dof": float(nis / jnp.maximum(trace.info.dof.sum(), 1)),
        "log-likelihood": float(trace.info.log_likelihood.sum()),
        # P0 = 0 is singular until noise has entered; from then on P must stay positive definite.
        "positive definite from step": 2 + int(np.max(np.flatnonzero(~trace.probe), initial=-1)),
        "final pose": [float(value) for value in last.pose],
        "seconds": round(seconds, 2),
    }
    surveyed = None
    if data.landmarks is not None and summary["landmarks"]:
        frame, summary["map RMSE after alignment [m]"] = align_map(last, data.landmarks)
        into_map = jax.vmap(se2.to_frame, (None, 0))
        surveyed = np.asarray(into_map(jnp.asarray(frame), jnp.asarray(data.landmarks)))
    from jaxslam import plot  # matplotlib only once there is a result to draw

    figure = plot.map_figure(trace.estimate, true_points=surveyed, title=data.name)
    files: dict[str, str | Callable[[Path], object]] = {
        "trajectory.csv": report.trajectory_csv(data.time, trace.estimate),
        "map.csv": report.map_csv(last, data.tags),
        "summary.json": report.json_text(summary | {"versions": report.versions()}),
        "map.png": figure.savefig,
    }
    for name, value in summary.items():
        print(f"{name:30} {_shown(value)}")
    written = report.write_files(options.out, files)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {count:,}" for key, count in value.items()) or "-"
    if isinstance(value, list):
        return "; ".join(_shown(part) for part in value) or "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
