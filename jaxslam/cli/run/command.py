"""The command `jaxslam run`: filters on a recorded data set."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxslam.cli.common import (
    COUNT,
    SUMMARY,
    check_out,
    pick,
    summary_table,
)
from jaxslam.cli.films import NAMES as FILMS
from jaxslam.cli.laser.command import run_laser
from jaxslam.cli.laser.options import READERS as LASER_LOGS
from jaxslam.cli.laser.options import refuse_laser_options
from jaxslam.cli.run.film import film_steps, films, shown_state
from jaxslam.cli.run.filters import chosen_filters, on_true_poses, with_options
from jaxslam.cli.run.piecewise import PiecewiseRun, run_in_pieces
from jaxslam.consistency.campaign.progress import Progress
from jaxslam.consistency.measures.counts import count_label
from jaxslam.core.protocols import Filter
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Status
from jaxslam.datasets import READERS, Dataset, Reader
from jaxslam.datasets.evaluation import Evaluation, evaluate, joint_map_cov
from jaxslam.results import report
from jaxslam.results.campaign_files import check_figure_formats
from jaxslam.results.files import Json, json_text, versions, write_files


def run_dataset(options: argparse.Namespace, command: str) -> int:
    """Run filters over the data set, print and write their results; returns the exit status."""
    if options.dataset in LASER_LOGS:
        return run_laser(options, command)
    refuse_laser_options(options)
    if options.check_every is not None and options.check_every < 0:
        raise ValueError(f"--check-every: expected at least 0, got {options.check_every}")
    formats = check_figure_formats("--figures", options.figures.split(","))
    data = _reader(options.dataset)(options.path, options.robot)
    data = with_options(data, options)
    filters = chosen_filters(data, options.filters or "ekf")
    check_out(options.out, "run")
    at = film_steps(data) if options.animate else None
    runs = {name: _run(name, filter, data, options, at) for name, filter in filters.items()}
    last = next(iter(runs.values())).result.last
    summary: Json = {
        "dataset": data.name,
        "source": data.source,
        "command": command,
        "dtype": str(last.pose.dtype),
        "steps": data.steps,
        "measurements": data.measurements,
        "dropped by the reader": data.dropped,
        "corrections to the data": list(data.corrections),
        "defaults taken": list(data.assumed),
    }
    several = len(runs) > 1
    if several:
        print(summary_table({"": summary}), end="\n\n")
        print(summary_table({name: _flat(run.summary) for name, run in runs.items()}))
        summary["filters"] = {name: run.summary for name, run in runs.items()}
    else:
        summary |= next(iter(runs.values())).summary
        print(summary_table({"": summary}))
    files: dict[str, str | Callable[[Path], object]] = {}
    for name, run in runs.items():
        suffix = f"-{name}" if several else ""
        files[f"trajectory{suffix}.csv"] = report.trajectory_csv(data.time, run.result.path)
        files[f"trajectory{suffix}.tum"] = report.trajectory_tum(data.time, run.result.path)
        files[f"map{suffix}.csv"] = report.map_csv(run.result.last, data.tags)
    files[SUMMARY] = json_text(summary | {"versions": versions()})
    files |= _figure(data, runs, formats)
    if at is not None:
        files |= films(data, {name: run[:2] for name, run in runs.items()}, at)
    written = write_files(options.out, files, replaces=FILMS)
    print("\nwrote " + ", ".join(str(path) for path in written))
    return 0


def _reader(name: str) -> Reader:
    return pick("dataset", name, READERS, f", {', '.join(LASER_LOGS)}")


class _Run(NamedTuple):
    """A filter's results on a data set."""

    result: PiecewiseRun
    found: Evaluation
    summary: Json


def _run(
    name: str,
    filter: Filter,
    data: Dataset,
    options: argparse.Namespace,
    at: Int[np.ndarray, "F"] | None,
) -> _Run:
    """Run one filter over a data set; its covariance is checked where the state holds P.

    at: the steps that a film shows, None without one.
    """

    def check(state: Joint) -> bool:
        return positive_definite(np.asarray(state.cov))

    pose, pose_cov = (np.asarray(part, np.float64) for part in (data.pose, data.pose_cov))
    state = jax.eval_shape(filter.init, pose, pose_cov)
    has_covariance = isinstance(state, Joint) and name != "square_root"
    log, unplaced = on_true_poses(data) if name == "mapping" else (data.log, 0)
    with Progress(f"{data.name}, {name}", "steps") as progress:
        began = time.perf_counter()
        # The reader has checked the values; `asarray` converts the log to the chosen dtype.
        result = run_in_pieces(
            filter,
            jax.tree.map(jnp.asarray, log),
            pose,
            pose_cov,
            every=options.check_every if has_covariance else 0,
            check=check,
            progress=progress,
            at=at,
            watch=shown_state,
        )
    seconds = time.perf_counter() - began
    last = result.last
    nis = np.where(result.status == Status.FUSED, result.nis, 0.0).sum()
    dof = int(result.dof.sum())
    innovations = {  # of a filter that has some
        "NIS / dof": float(nis / max(dof, 1)),
        "log-likelihood": float(result.log_likelihood.sum()),
    }
    found = evaluate(data, result.path, last, joint_map_cov(filter, result.final))
    summary = {
        "landmarks": int(last.alive.sum()),
        "status": {
            s.name.lower(): int((result.status == s).sum()) for s in Status if s != Status.EMPTY
        },
        **({"measurements without a true pose, left out": unplaced} if unplaced else {}),
        **(innovations if dof else {}),
        "P positive definite": _definiteness(result),
        "final pose": [float(value) for value in last.pose],
        "seconds": round(seconds, 2),
    }
    tested = {} if found.map_test is None else found.map_test.rows()
    return _Run(result, found, summary | found.errors | tested)


def _figure(
    data: Dataset, runs: dict[str, _Run], formats: tuple[str, ...]
) -> dict[str, Callable[[Path], object]]:
    """The function that draws the map: the first filter with ellipses and truth, others without."""
    from jaxslam.results import plot  # matplotlib is slow to load

    (name, first), *rest = runs.items()
    found = first.found
    figure = plot.map_figure(
        _whole(first.result),
        true_points=found.points,
        names=None if found.points is None else data.tags,
        true_path=found.path,
        dead_reckoning=_dead_reckoning(data),
        others={each: _whole(run.result) for each, run in rest},
        title=f"{data.name}: {name} with ellipses" if rest else data.name,
    )

    def saved(kind: str) -> Callable[[Path], object]:
        return lambda path: path.write_bytes(plot.encode(figure, kind))

    return {f"map.{kind}": saved(kind) for kind in formats}


def _whole(result: PiecewiseRun) -> Estimate:
    """The estimated path with the map of its end."""
    last = result.last
    at_end = {name: getattr(last, name)[None] for name in ("points", "point_covs", "alive", "tag")}
    return result.path._replace(**at_end)


def positive_definite(cov: Float[np.ndarray, "D D"]) -> bool:
    """Whether a covariance has a finite Cholesky factor, by NumPy."""
    try:
        return bool(np.isfinite(np.linalg.cholesky(cov)).all())
    except np.linalg.LinAlgError:
        return False


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


def _flat(summary: Json) -> Json:
    """The summary as rows of one value: a row a status that occurs, a row a coordinate."""
    status, final = summary["status"], summary["final pose"]
    assert isinstance(status, dict)
    assert isinstance(final, list)
    counts = {f"{COUNT}{count_label(name)}": count for name, count in status.items() if count}
    names = ("x [m]", "y [m]", "theta [rad]")
    pose = {f"final {n}": value for n, value in zip(names, final, strict=True)}
    rows = {key: summary[key] for key in summary if key not in ("status", "final pose")}
    return counts | rows | pose
