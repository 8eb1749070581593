"""The command `jaxslam run`: EKF-SLAM on a recorded data set."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam.cli.common import Progress, pick
from jaxslam.cli.piecewise import PiecewiseRun, run_in_pieces
from jaxslam.datasets import READERS
from jaxslam.datasets.evaluation import Evaluation, evaluate
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.results import report
from jaxslam.results.files import check_writable, json_text, versions, write_files
from jaxslam.types import Status, Truth


def run_dataset(options: argparse.Namespace, command: str) -> int:
    """Run EKF-SLAM over the data set, print and write its results; returns the exit status."""
    if options.check_every is not None and options.check_every < 0:
        raise ValueError(f"--check-every: expected at least 0, got {options.check_every}")
    data = pick("dataset", options.dataset, READERS)(options.path, options.robot)
    check_writable(options.out)
    ekf = ekf_slam(data.motion, data.sensor, data.capacity, **data.filter_options)
    with Progress(data.name, "steps") as progress:
        began = time.perf_counter()
        # The reader has checked the values; `asarray` converts the log to the chosen dtype.
        result = run_in_pieces(
            ekf,
            jax.tree.map(jnp.asarray, data.log),
            data.pose,
            data.pose_cov,
            every=options.check_every,
            check=lambda joint: positive_definite(np.asarray(joint.cov)),
            progress=progress,
        )
    seconds = time.perf_counter() - began
    last = result.last
    nis = np.where(result.status == Status.FUSED, result.nis, 0.0).sum()
    summary: dict[str, Any] = {
        "dataset": data.name,
        "source": data.source,
        "command": command,
        "dtype": str(last.pose.dtype),
        "steps": data.steps,
        "measurements": data.measurements,
        "landmarks": int(last.alive.sum()),
        "status": {
            s.name.lower(): int((result.status == s).sum()) for s in Status if s != Status.EMPTY
        },
        "dropped by the reader": data.dropped,
        "corrections to the data": list(data.corrections),
        "defaults taken": list(data.assumed),
        "NIS / dof": float(nis / max(int(result.dof.sum()), 1)),
        "log-likelihood": float(result.log_likelihood.sum()),
        "P positive definite": _definiteness(result),
        "final pose": [float(value) for value in last.pose],
        "seconds": round(seconds, 2),
    }
    found = evaluate(data, result.path, last)
    summary |= found.errors
    from jaxslam.results import plot  # matplotlib is slow to load

    at_end = {name: getattr(last, name)[None] for name in ("points", "point_covs", "alive")}
    figure = plot.map_figure(
        result.path._replace(**at_end),
        truth=_truth(found),
        true_points=found.points,
        title=data.name,
    )
    files: dict[str, str | Callable[[Path], object]] = {
        "trajectory.csv": report.trajectory_csv(data.time, result.path),
        "map.csv": report.map_csv(last, data.tags),
        "summary.json": json_text(summary | {"versions": versions()}),
        "map.png": figure.savefig,
    }
    width = max(map(len, summary))
    for name, value in summary.items():
        print(f"{name:{width}} {_shown(value)}")
    written = write_files(options.out, files)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def _truth(found: Evaluation) -> Truth | None:
    """The true path and the survey as the figure takes them; None without a true path."""
    if found.path is None:
        return None
    points: Any = np.zeros((0, 2)) if found.points is None else found.points
    path: Any = found.path
    missed: Any = np.zeros(len(path))
    return Truth(path, points, missed, path[0])


def positive_definite(cov: Float[np.ndarray, "D D"]) -> bool:
    """Whether a covariance has a finite Cholesky factor, by NumPy."""
    try:
        return bool(np.isfinite(np.linalg.cholesky(cov)).all())
    except np.linalg.LinAlgError:
        return False


def _definiteness(result: PiecewiseRun) -> str:
    """A phrase: at how many of the checked steps P was positive definite, and where not."""
    if not result.checked:
        return "not checked"
    failed = [step for step, good in zip(result.checked, result.passed, strict=True) if not good]
    count = f"at {sum(result.passed)} of {len(result.passed)} checked steps"
    if not failed:
        return count
    more = ", …" if len(failed) > 5 else ""
    return f"{count}, not at {', '.join(map(str, failed[:5]))}{more}"


def _shown(value: object) -> str:
    """A value of the summary as it is printed."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {count:,}" for key, count in value.items()) or "-"
    if isinstance(value, list):
        return "; ".join(_shown(part) for part in value) or "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
