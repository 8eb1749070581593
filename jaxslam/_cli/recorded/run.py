"""The command `jaxslam run`: filters on a recorded data set."""

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam._cli import cache, model_checks
from jaxslam._cli.common import (
    COUNT,
    FILMS,
    SUMMARY,
    Drawings,
    add_animate,
    add_dtype,
    add_figures,
    add_out,
    check_out,
    film_files,
    pick,
    summary_table,
    write_results,
)
from jaxslam._cli.recorded.filter_choice import (
    NAMES,
    chosen_filters,
    read_dataset,
    with_options,
)
from jaxslam._cli.recorded.filter_run import FilterRun, run_filter
from jaxslam.consistency import ModelCheck
from jaxslam.consistency._measures.counts import count_label
from jaxslam.core.protocols import POSE, Filter
from jaxslam.core.types import Estimate
from jaxslam.core.validation import require
from jaxslam.datasets import READERS, Dataset
from jaxslam.datasets._evaluation import Evaluation
from jaxslam.datasets._landmark_logs.table_settings import METHODS
from jaxslam.linearize._first_order import nominal_path
from jaxslam.results import report
from jaxslam.results._campaign_files import FORMATS, formats_of_figures
from jaxslam.results._files import Files, Json, json_text, versions
from jaxslam.simulation import Twin, twin


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam run`."""
    parser.add_argument(
        "--dataset",
        required=True,
        help=f"one of: {', '.join(READERS)}; or a laser log: carmen, rosbag",
    )
    parser.add_argument("path", metavar="PATH", help="the file, or the folder, of the data set")
    parser.add_argument(
        "--robot",
        type=int,
        help="number of the robot, of several (default: the first)",
    )
    parser.add_argument(
        "--filters",
        default="ekf",
        help=f"some of: {', '.join(NAMES)}; with commas between them (default: ekf)",
    )
    parser.add_argument(
        "--gate",
        type=float,
        metavar="P",
        help="probability that a correct measurement passes the gate, as 0.999 (default: that of "
        "the reader, mostly none)",
    )
    parser.add_argument(
        "--associate",
        metavar="METHOD",
        help=f"one of: {', '.join(METHODS)} (default: that of the reader, mostly known)",
    )
    parser.add_argument(
        "--innovations",
        action="store_true",
        help="also write innovations.csv, as jaxslam judge reads it: each innovation with its "
        "covariance",
    )
    model_checks.add_options(parser)
    add_figures(parser, FORMATS)
    add_animate(parser, "of each filter")
    cache.add_options(parser)
    add_dtype(parser, " of the filter")
    add_out(parser)
    parser.set_defaults(command=run_dataset)


@dataclasses.dataclass(frozen=True, eq=False)
class RunPlan:
    """Plan of `jaxslam run`: the filters to run over a data set."""

    data: Dataset
    filters: Mapping[str, Filter]
    animate: bool = False
    """whether whole estimates are kept for films"""
    innovations: bool = False
    """whether innovations are kept for a file"""
    world: Twin | None = None
    """the twin of the log, where it is checked"""
    twins: int = 100
    """their number"""

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> "RunPlan":
        """Read the data set that the options of the command name, and build its filters."""
        if options.check:
            model_checks.check_count(options.twins)
        if options.dataset not in READERS:  # laser logs are read by another command
            pick("dataset", options.dataset, {**READERS, "carmen": None, "rosbag": None})
        data = with_options(read_dataset(options.dataset, options.path, options.robot), options)
        return cls(
            data,
            chosen_filters(data, options.filters),
            options.animate,
            options.innovations,
            twin(data) if options.check else None,
            options.twins,
        )


def run_dataset(options: argparse.Namespace, command: str) -> int:
    """Run filters over the data set, print and write their results; returns the exit status."""
    formats = require("--figures", options.figures.split(","), formats_of_figures)
    plan = RunPlan.from_options(options)
    check_out(options.out, "run")
    runs = run_filters(plan)
    summary = summarize(plan.data, runs, command)
    print_summary(summary, runs)
    checks: dict[str, ModelCheck] = {}
    if plan.world is not None:
        key = jax.random.key(0)
        checks = model_checks.check_log(plan.world, plan.filters, plan.data.log, plan.twins, key)
    return write_runs(options.out, plan, runs, summary, formats, checks)


def run_filters(plan: RunPlan) -> dict[str, FilterRun]:
    """Run the filters of a plan, one after the other; their results by name."""
    from jaxslam.results.plot._run_film import frame_steps  # matplotlib is slow to load

    data = plan.data
    film_steps = frame_steps(data.steps, time=data.time) if plan.animate else None
    return {
        name: run_filter(name, filter, data, film_steps, plan.innovations)
        for name, filter in plan.filters.items()
    }


def summarize(data: Dataset, runs: Mapping[str, FilterRun], command: str) -> Json:
    """The summary: the data set, then the run, or `filters` with the run of each of several."""
    first, *others = runs.values()
    summary: Json = {
        "dataset": data.name,
        "source": data.source,
        "command": command,
        "dtype": str(first.result.last.pose.dtype),
        "steps": data.steps,
        "measurements": data.measurements,
        "dropped by the reader": data.dropped,
        "corrections to the data": list(data.corrections),
        "defaults taken": list(data.assumed),
        **({} if data.true_path is None else {"rows without a true pose": data.rows_without_truth}),
    }
    if not others:
        return summary | first.summary
    return summary | {"filters": {name: run.summary for name, run in runs.items()}}


def print_summary(summary: Json, runs: Mapping[str, FilterRun]) -> None:
    """Print the summary; several filters side by side, and their notes below."""
    if "filters" not in summary:
        print(summary_table({"": summary}))
        return
    of_data = {key: value for key, value in summary.items() if key != "filters"}
    print(summary_table({"": of_data}), end="\n\n")
    columns = {}
    for name, run in runs.items():
        # A row has one value: one row a status that occurs, one a coordinate.
        status, final = run.summary["status"], run.summary["final pose"]
        assert isinstance(status, dict)
        assert isinstance(final, list)
        rows = {f"{COUNT}{count_label(word)}": count for word, count in status.items() if count}
        rows |= {
            key: value
            for key, value in run.summary.items()
            if key not in ("status", "final pose", "notes")
        }
        columns[name] = rows | {f"final {c}": x for c, x in zip(POSE, final, strict=True)}
    print(summary_table(columns))
    for name, run in runs.items():
        if notes := run.summary.get("notes"):
            print(summary_table({"": {name: notes}}))


def write_runs(
    folder: Path,
    plan: RunPlan,
    runs: Mapping[str, FilterRun],
    summary: Json,
    formats: tuple[str, ...],
    checks: Mapping[str, ModelCheck] = MappingProxyType({}),
) -> int:
    """Write trajectories, maps, the summary, checks, figures and films; returns the exit status."""
    data = plan.data
    files: Files = model_checks.check_files(checks)
    for name, run in runs.items():
        suffix = f"-{name}" if len(runs) > 1 else ""
        further = () if run.result.path.further is None else data.motion.state[3:]
        path_text = report.trajectory_csv(data.time, run.result.path, further)
        files[f"trajectory{suffix}.csv"] = path_text
        files[f"trajectory{suffix}.tum"] = report.trajectory_tum(data.time, run.result.path)
        files[f"map{suffix}.csv"] = report.map_csv(run.result.last, data.tags)
        if plan.innovations:
            files[f"innovations{suffix}.csv"] = report.innovations_csv(
                data.time,
                np.asarray(data.log.scan.tag),
                run.result.kept,
                data.tags,
                data.sensor.measurements,
            )
    files[SUMMARY] = json_text(summary | {"versions": versions()})
    drawings: Drawings = {"map": lambda: _figure(data, runs, formats)}
    drawings |= model_checks.check_drawings(checks, formats)
    if plan.animate:
        drawings["film"] = lambda: _films(data, runs)
    return write_results(folder, files, drawings, FILMS)


def _figure(data: Dataset, runs: Mapping[str, FilterRun], formats: tuple[str, ...]) -> Files:
    """The figure of the map: the first filter with ellipses and truth, others without."""
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._style import pictures

    (name, first), *others = runs.items()
    evaluation = first.evaluation
    start, controls = jnp.asarray(data.pose), jnp.asarray(data.log.control)
    robots = np.asarray(nominal_path(data.motion, start, controls))
    figure = plot.map_figure(
        _path_with_map(first),
        true_points=evaluation.points,
        names=None if evaluation.points is None else data.tags,
        true_path=_true_path(data, evaluation),
        dead_reckoning=robots[:, :3],
        others={label: _path_with_map(run) for label, run in others},
        title=f"{data.name}: {name} with ellipses" if others else data.name,
    )
    return {**pictures("map", figure, formats)}


def _path_with_map(run: FilterRun) -> Estimate:
    """The estimated path with the final map, with a leading axis of 1."""
    last = run.result.last
    final_map = {
        name: getattr(last, name)[None] for name in ("points", "point_covs", "alive", "tag")
    }
    return run.result.path._replace(**final_map)


def _true_path(data: Dataset, evaluation: Evaluation) -> Float[np.ndarray, "T 3"] | None:
    """The true path in the frame of the map, NaN where it is not known."""
    if evaluation.path is None:
        return None
    path = np.full((data.steps, 3), np.nan)
    path[slice(None) if data.true_at is None else data.true_at] = evaluation.path
    return path


def _films(data: Dataset, runs: Mapping[str, FilterRun]) -> Files:
    """The film of each filter, by file name; see `film_files`."""
    # Matplotlib is slow to load.
    from jaxslam.results.plot._run_film import History, frame_steps, run_film

    films = {}
    for name, (result, evaluation, _) in runs.items():
        assert result.estimates is not None
        history = History(
            path=np.asarray(result.path.pose),
            step=frame_steps(data.steps, time=data.time),
            estimate=result.estimates,
            tag=np.asarray(data.log.scan.tag),
            status=result.status,
            slot=result.slot,
            seen=result.watched,
        )
        films[name] = run_film(
            history,
            true_points=evaluation.points,
            true_path=_true_path(data, evaluation),
            title=f"{data.name}: {name}",
        )
    return film_files(films, suffixed=len(films) > 1)
