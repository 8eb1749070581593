"""The command `jaxslam run`: filters on a recorded data set."""

import argparse
import dataclasses
import inspect
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxslam._cli import cache
from jaxslam._cli.campaigns.piecewise import PiecewiseRun, run_in_pieces
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
from jaxslam.association._rules import Known
from jaxslam.catalog import ALL, KINDS, SMOOTHERS, on_given_poses
from jaxslam.consistency._measures.counts import count_label
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core.protocols import Candidate, Filter, Motion, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Log, Status, Truth
from jaxslam.core.validation import InvalidField
from jaxslam.datasets import READERS, Dataset
from jaxslam.datasets._evaluation import Evaluation, evaluate, joint_map_cov
from jaxslam.datasets._landmark_logs.table_settings import METHODS, association_options
from jaxslam.datasets._uncertain_constants import considered
from jaxslam.math._definite import indefinite
from jaxslam.results import _report as report
from jaxslam.results._campaign_files import FORMATS, check_figure_formats
from jaxslam.results._files import Files, Json, json_text, versions
from jaxslam.simulation._worlds import Scenario


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
    add_figures(parser, FORMATS)
    add_animate(parser, "of each filter")
    cache.add_options(parser)
    add_dtype(parser, " of the filter")
    add_out(parser)
    parser.set_defaults(command=run_dataset)


def run_dataset(options: argparse.Namespace, command: str) -> int:
    """Run filters over the data set, print and write their results; returns the exit status."""
    from jaxslam.results.plot._run_film import frame_steps  # matplotlib is slow to load

    formats = check_figure_formats("--figures", options.figures.split(","))
    if options.dataset not in READERS:  # laser logs are read by another command
        pick("dataset", options.dataset, {**READERS, "carmen": None, "rosbag": None})
    reader = READERS[options.dataset]
    if options.robot is not None and "robot" not in inspect.signature(reader).parameters:
        raise ValueError(
            f"--robot: expected none, since this data set has one robot, got {options.robot}"
        )
    data = reader(options.path, *([] if options.robot is None else [options.robot]))
    data = with_options(data, options)
    filters = chosen_filters(data, options.filters)
    check_out(options.out, "run")

    at = frame_steps(data.steps, time=data.time) if options.animate else None
    runs = {name: run_filter(name, filter, data, at) for name, filter in filters.items()}
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
        **({} if data.true_path is None else {"rows without a true pose": data.rows_without_truth}),
    }
    several = len(runs) > 1
    if several:
        print(summary_table({"": summary}), end="\n\n")
        print(summary_table({name: _flat(run.summary) for name, run in runs.items()}))
        for name, run in runs.items():
            if notes := run.summary.get("notes"):
                print(summary_table({"": {name: notes}}))
        summary["filters"] = {name: run.summary for name, run in runs.items()}
    else:
        summary |= next(iter(runs.values())).summary
        print(summary_table({"": summary}))
    files: Files = {}
    for name, run in runs.items():
        suffix = f"-{name}" if several else ""
        files[f"trajectory{suffix}.csv"] = report.trajectory_csv(data.time, run.result.path)
        files[f"trajectory{suffix}.tum"] = report.trajectory_tum(data.time, run.result.path)
        files[f"map{suffix}.csv"] = report.map_csv(run.result.last, data.tags)
    files[SUMMARY] = json_text(summary | {"versions": versions()})
    drawings: Drawings = {"map": lambda: _figure(data, runs, formats)}
    if at is not None:
        drawings["film"] = lambda: _films(data, runs, at)
    return write_results(options.out, files, drawings, FILMS)


class FilterRun(NamedTuple):
    """The results of a filter on a data set."""

    result: PiecewiseRun
    found: Evaluation
    summary: Json


def run_filter(
    name: str,
    filter: Filter,
    data: Dataset,
    at: Int[np.ndarray, "F"] | None,
) -> FilterRun:
    """Run one filter over a data set; the covariance is checked if the state has P.

    at: the steps of a film; None without one.
    """
    from jaxslam.results import plot  # matplotlib is slow to load

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
            progress=progress,
            check=check if has_covariance else None,
            at=at,
            watch=plot.probe,
        )
    seconds = time.perf_counter() - began
    last = result.last
    nis = np.where(result.status == Status.FUSED, result.nis, 0.0).sum()
    dof = int(result.dof.sum())
    innovations = {  # of filters that have innovations
        "NIS / dof": float(nis / max(dof, 1)),
        "log-likelihood": float(result.log_likelihood.sum()),
    }
    map_cov, added = joint_map_cov(filter, result.final), None
    if has_covariance:
        added = considered(data, lambda *models: chosen_filters(data, name, models)[name])
    if added is not None:
        covs = np.moveaxis(np.diagonal(added.points, axis1=0, axis2=2), -1, 0)
        result = result._replace(
            path=result.path._replace(pose_cov=result.path.pose_cov + added.pose),
            last=last._replace(
                pose_cov=last.pose_cov + added.pose[-1], point_covs=last.point_covs + covs
            ),
        )
        last = result.last
        map_cov = None if map_cov is None else map_cov + added.points
    uncertain = data.adjustable is not None and data.adjustable.cov is not None
    found = evaluate(data, result.path, last, map_cov)
    summary: Json = {
        "landmarks": int(last.alive.sum()),
        "status": {
            s.name.lower(): int((result.status == s).sum()) for s in Status if s != Status.EMPTY
        },
        **({"measurements without a true pose, left out": unplaced} if unplaced else {}),
        **(innovations if dof else {}),
        "P positive definite": _definiteness(result),
        **({"uncertainty of constants": "added" if added else "left out"} if uncertain else {}),
        "final pose": [float(value) for value in last.pose],
        "seconds": round(seconds, 2),
    }
    tested = {} if found.map_test is None else found.map_test.rows()
    summary |= found.errors | tested
    notes = suspicions(summary)
    return FilterRun(result, found, summary | ({"notes": notes} if notes else {}))


_NIS, _NEES = 30.0, 100.0
"""NIS / dof, and the NEES of pose or landmarks over the honest one, above which noises are not the
cause: innovations of 5 σ, errors of 10 σ."""


def suspicions(summary: Json) -> list[str]:
    """Sentences on numbers of a run that no honest filter with the models of the data has."""
    status, found = summary["status"], []
    assert isinstance(status, dict)
    nis = float(str(summary.get("NIS / dof", 0.0)))
    units = "models or units are wrong (degrees under [rad], millimetres under [m], the mount)"
    if nis > _NIS:
        found.append(f"NIS / dof is {nis:.4g}, where 1 is honest: {units}")
    elif (rejected := status["rejected"]) > sum(status.values()) / 2:
        found.append(f"the gate rejects {rejected:,} of {sum(status.values()):,}: {units}")
    else:
        for name, value in summary.items():
            of, honest = ("truth", 2.37) if name.startswith("pose NEES, median") else ("survey", 2)
            if name.startswith(("pose NEES, median", "landmark NEES")) and (
                (nees := float(str(value))) > honest * _NEES
            ):
                found.append(
                    f"{name.partition(' (')[0]} is {nees:.4g}, where {honest:g} is honest, though "
                    f"the innovations fit: the {of} may have other units (degrees under [rad], "
                    "millimetres under [m]), stamps or axes than the log"
                )
    return found


def _figure(data: Dataset, runs: dict[str, FilterRun], formats: tuple[str, ...]) -> Files:
    """The figure of the map: the first filter with ellipses and truth, others without."""
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._style import pictures

    (name, first), *rest = runs.items()
    found = first.found
    figure = plot.map_figure(
        _whole(first.result),
        true_points=found.points,
        names=None if found.points is None else data.tags,
        true_path=_true_path(data, found),
        dead_reckoning=_dead_reckoning(data),
        others={each: _whole(run.result) for each, run in rest},
        title=f"{data.name}: {name} with ellipses" if rest else data.name,
    )
    return {**pictures("map", figure, formats)}


def _true_path(data: Dataset, found: Evaluation) -> Float[np.ndarray, "T 3"] | None:
    """The true path in the frame of the map, NaN where it is not known."""
    if found.path is None:
        return None
    path = np.full((data.steps, 3), np.nan)
    path[slice(None) if data.true_at is None else data.true_at] = found.path
    return path


def _films(data: Dataset, runs: Mapping[str, FilterRun], at: Int[np.ndarray, "F"]) -> Files:
    """The film of each filter, by file name; see `film_files`."""
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._run_film import History, run_scene

    made = {}
    for name, (run, found, _) in runs.items():
        assert run.estimates is not None
        history = History(
            path=np.asarray(run.path.pose),
            step=at,
            estimate=run.estimates,
            tag=np.asarray(data.log.scan.tag),
            status=run.status,
            slot=run.slot,
            seen=run.watched,
        )
        scene = run_scene(
            history,
            true_points=found.points,
            true_path=_true_path(data, found),
            title=f"{data.name}: {name}",
        )
        made[name] = plot.Film(scene)
    return film_files(made, suffixed=len(made) > 1)


def _whole(result: PiecewiseRun) -> Estimate:
    """The estimated path with the final map."""
    last = result.last
    at_end = {name: getattr(last, name)[None] for name in ("points", "point_covs", "alive", "tag")}
    return result.path._replace(**at_end)


def positive_definite(cov: Float[np.ndarray, "D D"]) -> bool:
    """Whether a covariance is finite and has no negative eigenvalue; 0 may be one."""
    return bool(np.isfinite(cov).all()) and not indefinite(cov)


def _dead_reckoning(data: Dataset) -> Float[np.ndarray, "T 3"]:
    """The path by the controls alone, without noise."""
    nominal = jnp.zeros(len(data.motion.noises))

    def step(pose: jax.Array, control: jax.Array) -> tuple[jax.Array, jax.Array]:
        pose = data.motion.step(pose, control, nominal)
        return pose, pose

    drive = jax.jit(lambda pose, controls: jax.lax.scan(step, pose, controls)[1])
    return np.asarray(drive(jnp.asarray(data.pose), jnp.asarray(data.log.control)))


def _definiteness(result: PiecewiseRun) -> str:
    """The number of checked steps with positive definite P, and the first without, as text."""
    if not result.checked:
        return "not checked"
    failed = [step for step, good in zip(result.checked, result.passed, strict=True) if not good]
    count = f"at {sum(result.passed)} of {len(result.passed)} checked steps"
    if not failed:
        return count
    more = ", …" if len(failed) > 5 else ""
    return f"{count}, not at {', '.join(map(str, failed[:5]))}{more}"


def _flat(summary: Json) -> Json:
    """The summary as rows of one value: one per status that occurs, one per coordinate."""
    status, final = summary["status"], summary["final pose"]
    assert isinstance(status, dict)
    assert isinstance(final, list)
    counts = {f"{COUNT}{count_label(name)}": count for name, count in status.items() if count}
    names = ("x [m]", "y [m]", "theta [rad]")
    pose = {f"final {n}": value for n, value in zip(names, final, strict=True)}
    rows = {key: summary[key] for key in summary if key not in ("status", "final pose", "notes")}
    return counts | rows | pose


NAMES = tuple(name for name in ALL if name not in ("ideal", "batch_map"))
"""Filters for a data set: those that need neither the truth nor the whole log at once."""


def with_options(data: Dataset, options: argparse.Namespace) -> Dataset:
    """The data set with the gate and the association of the command."""
    if options.gate is None and options.associate is None:
        return data
    if options.associate is None and data.filter_options.get("associate") is not None:
        raise ValueError("--gate: expected --associate, too, since the tags are not used")
    try:
        chosen = association_options(options.associate or "known", options.gate)
    except InvalidField as problem:
        raise ValueError(f"--{problem.field}: {problem.reason}") from problem
    given = [name for name in ("gate", "associate") if getattr(options, name) is not None]
    assumed = (
        line for line in data.assumed if not line.startswith(tuple(f"[filter] {n}" for n in given))
    )
    plain: dict[str, Any] = {"gate": None, "associate": Known()}
    changed = data.filter_options | plain | chosen
    return dataclasses.replace(data, filter_options=changed, assumed=tuple(assumed))


def chosen_filters(
    data: Dataset, text: str, models: tuple[Motion, Sensor] | None = None
) -> dict[str, Filter]:
    """The filters of a comma-separated list of names, with the models of the data set or others.

    Raises ValueError on unknown or repeated names, and on a filter that needs what the data set
    does not have: the truth at every step, a map in the frame of the start, or tags.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise ValueError(f"--filters: expected different names with commas between, got {text!r}")
    slots = np.zeros((data.capacity, len(data.sensor.landmark)))
    motion, sensor = models or (data.motion, data.sensor)
    world = Scenario(
        name=data.name,
        motion=motion,
        sensor=sensor,
        landmarks=slots,
        controls=data.log.control,
        places=data.log.scan.tag.shape[1],
        filter_options=data.filter_options,
    )
    if user := next((name for name in names if ".py" in name), None):
        raise ValueError(
            f"--filters: {user}: `jaxslam run` takes filters of the catalog; give your own to "
            "`jaxslam.run` in Python"
        )
    known = {name: ALL[name] for name in ALL if name in NAMES or name in names}
    known["mapping"] = on_given_poses
    return {name: _filter(name, pick("filters", name, known)(world), data) for name in names}


def on_true_poses(data: Dataset) -> tuple[Log, int]:
    """The log with true poses as controls, for mapping, and the number of measurements left out.

    Without a true pose, the measurements are left out and the control is the last known pose.
    """
    assert data.true_path is not None
    known = np.ones(data.steps, bool) if data.true_at is None else data.true_at
    scan = data.log.scan
    kept = np.asarray(scan.valid) & known[:, None]
    latest = np.maximum.accumulate(np.where(known, np.arange(data.steps), int(np.argmax(known))))
    lost = int(np.sum(scan.valid)) - int(kept.sum())
    return Log(jnp.asarray(data.true_path[latest]), scan._replace(valid=kept)), lost


def _filter(name: str, candidate: Candidate, data: Dataset) -> Filter:
    if data.filter_options.get("associate") is not None and (
        name in KINDS["information"] or name == "localization"
    ):
        raise ValueError(f"--filters: {name} needs the tag of every measurement")
    if name == "mapping" and data.true_path is None:
        raise ValueError("--filters: mapping needs the true path of the robot")
    if isinstance(candidate, Filter):
        return candidate
    if name in SMOOTHERS:
        raise ValueError(
            f"--filters: {name} takes a whole log at once: call "
            f"jaxslam.graphs.smoothing.{name} from Python"
        )
    if name == "ideal" or not data.one_frame or data.landmarks is None:
        needs = (
            "the true path of a simulation"
            if name == "ideal"
            else ("a map, landmarks.csv, in the frame of the start")
        )
        raise ValueError(f"--filters: {name} needs {needs}")
    nothing = np.zeros(0)
    made = candidate(Truth(nothing, data.landmarks, nothing, nothing))
    assert isinstance(made, Filter)
    return made
