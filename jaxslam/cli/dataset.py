"""`jaxslam run`: EKF-SLAM on recorded data."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.cli.asking import Progress, pick
from jaxslam.cli.driving import Driven, drive
from jaxslam.consistency import align_map
from jaxslam.datasets import READERS
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.math import se2
from jaxslam.results import report
from jaxslam.types import Status


def run_dataset(options: argparse.Namespace, command: str) -> int:
    """Run EKF-SLAM over the data set, print its summary, write its files; exit status."""
    if options.check_every is not None and options.check_every < 0:
        raise ValueError(f"run: expected --check-every of at least 0, got {options.check_every}")
    data = pick("dataset", options.dataset, READERS)(options.path, options.robot)
    report.check_writable(options.out)
    ekf = ekf_slam(data.motion, data.sensor, data.capacity, **data.filter_options)
    with Progress(data.name, "steps") as progress:
        began = time.perf_counter()
        # The reader has checked the values; the log enters the run in the chosen dtype.
        driven = drive(
            ekf,
            jax.tree.map(jnp.asarray, data.log),
            data.pose,
            data.pose_cov,
            every=options.check_every,
            look=lambda joint: positive_definite(np.asarray(joint.cov)),
            progress=progress,
        )
    seconds = time.perf_counter() - began
    last = driven.last
    nis = np.where(driven.status == Status.FUSED, driven.nis, 0.0).sum()
    summary: dict[str, Any] = {
        "dataset": data.name,
        "source": data.source,
        "command": command,
        "dtype": str(last.pose.dtype),
        "steps": data.steps,
        "measurements": data.measurements,
        "landmarks": int(last.alive.sum()),
        "status": {
            s.name.lower(): int((driven.status == s).sum()) for s in Status if s != Status.EMPTY
        },
        "dropped by the reader": data.dropped,
        "corrections to the data": list(data.corrections),
        "NIS / dof": float(nis / max(int(driven.dof.sum()), 1)),
        "log-likelihood": float(driven.log_likelihood.sum()),
        "P positive definite": _counted(driven),
        "final pose": [float(value) for value in last.pose],
        "seconds": round(seconds, 2),
    }
    surveyed = None
    if data.landmarks is not None and summary["landmarks"]:
        frame, summary["map RMSE after alignment [m]"] = align_map(last, data.landmarks)
        into_map = jax.vmap(se2.to_frame, (None, 0))
        surveyed = np.asarray(into_map(jnp.asarray(frame), jnp.asarray(data.landmarks)))
    from jaxslam.results import plot  # matplotlib only once there is a result to draw

    at_end = {name: getattr(last, name)[None] for name in ("points", "point_covs", "alive")}
    figure = plot.map_figure(driven.path._replace(**at_end), true_points=surveyed, title=data.name)
    files: dict[str, str | Callable[[Path], object]] = {
        "trajectory.csv": report.trajectory_csv(data.time, driven.path),
        "map.csv": report.map_csv(last, data.tags),
        "summary.json": report.json_text(summary | {"versions": report.versions()}),
        "map.png": figure.savefig,
    }
    for name, value in summary.items():
        print(f"{name:30} {_shown(value)}")
    written = report.write_files(options.out, files)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def positive_definite(cov: np.ndarray) -> bool:
    """Whether a covariance (D, D) has a Cholesky factor; on the host."""
    try:
        return bool(np.isfinite(np.linalg.cholesky(cov)).all())
    except np.linalg.LinAlgError:
        return False


def _counted(driven: Driven) -> str:
    """In how many of the steps looked at the covariance was positive definite, and where not."""
    if not driven.looked:
        return "not looked at"
    not_there = [step for step, good in zip(driven.looked, driven.found, strict=True) if not good]
    of = f"at {sum(driven.found)} of {len(driven.found)} steps looked at"
    if not not_there:
        return of
    more = ", …" if len(not_there) > 5 else ""
    return f"{of}, not at {', '.join(map(str, not_there[:5]))}{more}"


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {count:,}" for key, count in value.items()) or "-"
    if isinstance(value, list):
        return "; ".join(_shown(part) for part in value) or "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
