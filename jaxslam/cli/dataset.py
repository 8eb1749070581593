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

from jaxslam.cli.common import pick
from jaxslam.cli.piecewise import PiecewiseRun, run_in_pieces
from jaxslam.consistency import align_map
from jaxslam.datasets import READERS, Dataset
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.math import se2
from jaxslam.monte_carlo.progress import Progress
from jaxslam.results import report
from jaxslam.results.files import check_writable, json_text, versions, write_files
from jaxslam.types import Status


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
        "NIS / dof": float(nis / max(int(result.dof.sum()), 1)),
        "log-likelihood": float(result.log_likelihood.sum()),
        "P positive definite": _definiteness(result),
        "final pose": [float(value) for value in last.pose],
        "seconds": round(seconds, 2),
    }
    surveyed: dict[str, Any] = {}
    if data.landmarks is not None and summary["landmarks"]:
        frame, summary["map RMSE after alignment [m]"] = align_map(last, data.landmarks)
        surveyed = {"true_points": _in_frame(frame, data.landmarks), "names": data.tags}
        if data.true_path is not None:
            surveyed["true_path"] = _in_frame(frame, data.true_path[:, :2])
    from jaxslam.results import plot  # matplotlib is slow to load

    at_end = {name: getattr(last, name)[None] for name in ("points", "point_covs", "alive", "tag")}
    figure = plot.map_figure(
        result.path._replace(**at_end),
        dead_reckoning=_dead_reckoning(data),
        title=data.name,
        **surveyed,
    )
    files: dict[str, str | Callable[[Path], object]] = {
        "trajectory.csv": report.trajectory_csv(data.time, result.path),
        "map.csv": report.map_csv(last, data.tags),
        "summary.json": json_text(summary | {"versions": versions()}),
        "map.png": lambda path: path.write_bytes(plot.png(figure)),
    }
    for name, value in summary.items():
        print(f"{name:30} {_shown(value)}")
    written = write_files(options.out, files)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def positive_definite(cov: Float[np.ndarray, "D D"]) -> bool:
    """Whether a covariance has a finite Cholesky factor, by NumPy."""
    try:
        return bool(np.isfinite(np.linalg.cholesky(cov)).all())
    except np.linalg.LinAlgError:
        return False


def _in_frame(
    frame: Float[np.ndarray, "3"], points: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, "N 2"]:
    """Points in the coordinates of a frame."""
    into = jax.vmap(se2.to_frame, (None, 0))
    return np.asarray(into(jnp.asarray(frame), jnp.asarray(points)))


def _dead_reckoning(data: Dataset) -> Float[np.ndarray, "T 3"]:
    """The path by the controls alone, without noise."""
    nominal = jnp.zeros(len(data.motion.noises))

    def step(pose: jax.Array, control: jax.Array) -> tuple[jax.Array, jax.Array]:
        pose = data.motion.step(pose, control, nominal)
        return pose, pose

    drive = jax.jit(lambda pose, controls: jax.lax.scan(step, pose, controls)[1])
    return np.asarray(drive(jnp.asarray(data.pose), jnp.asarray(data.log.control)))


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
