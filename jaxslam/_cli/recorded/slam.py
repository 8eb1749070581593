"""The command `jaxslam slam`: laser SLAM, its files, and scores by poses or relations."""

import argparse
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxslam._cli.common import Drawings, add_animate, film_files, summary_table
from jaxslam._cli.recorded import laser_log
from jaxslam._cli.recorded.memory import memory_returned, trim
from jaxslam.consistency import metrics
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core._table import csv_text
from jaxslam.core.types import Estimate
from jaxslam.core.validation import InvalidField
from jaxslam.datasets import LaserLog, relation_file
from jaxslam.datasets import _g2o as g2o
from jaxslam.datasets import _ros_map as ros_map
from jaxslam.laser import laser_slam
from jaxslam.laser.laser_slam import LoopOutcome, Settings, Solved
from jaxslam.laser.laser_slam._log_map import growing_maps
from jaxslam.math.stats import chi2_quantile
from jaxslam.results import report
from jaxslam.results._files import Files, Json

if TYPE_CHECKING:  # Matplotlib is slow to load
    from jaxslam.results.plot import Film

METRES = (1.0, 2.0, 5.0, 10.0)
"""Lengths of path of the relations that score the result."""

FINAL_FRAMES = 12
"""Number of frames of a film with the map after closing."""

TOLERANCE = 1e-4
"""Largest difference between the stamps of a relation and of its scan [s]: public files print five
decimals, and times since 1970 have 2e-7 s in float64."""

FAR_APART = 60.0
"""Time between the scans of a relation beyond which they are far apart [s]."""

ELLIPSE_SHARE = 0.95
"""Expected share of relations in the ellipse, if the covariance is right and relations exact."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam slam`."""
    laser_log.add_options(parser, run_slam)
    add_animate(parser, "of the map growing")
    parser.add_argument(
        "--relations",
        metavar="FILE",
        help="relative poses between stamps that score the result, lines t1 t2 x y z roll pitch "
        "yaw [s, m, rad]",
    )


def run_slam(log: LaserLog, options: argparse.Namespace) -> laser_log.Job:
    """Compute path, graph, loops and map from raw odometry and scans.

    The poses in the file, and the relations of another file, score the result.
    """
    # Before the work, so that a wrong file is refused at once.
    relations_of_log = None if options.relations is None else read_relations(options.relations, log)
    settings = Settings(resolution=options.resolution)
    with memory_returned(), Progress(f"{log.name}, reading", "scans") as first:
        bars = {"": first}

        def report_stage(stage: str, done: int, of: int) -> None:
            if stage not in bars:
                unit = "candidates" if stage == "loop closing" else "scans"
                bars[stage] = Progress(f"{log.name}, {stage}", unit)
            bars[stage](done, of)
            if done == of:
                trim()

        solved = laser_slam.solve(log, settings, progress=report_stage)
    coarser = float(solved.map.resolution) > 1.001 * settings.resolution
    reference = log.corrected if log.placed else None
    files, drawings = result_files(solved), figures(solved, options.figures, reference)
    if options.animate:
        drawings["film"] = lambda: film_files({"slam": film(log, solved, settings)}, suffixed=False)
    summary = result_summary(solved) | laser_log.score_or_reason(log, lambda: _scores(log, solved))
    if coarser:
        summary["requested resolution, of too many cells [m]"] = settings.resolution
    if relations_of_log is None:
        return laser_log.Job(summary, files, drawings=drawings)
    relations, dropped = relations_of_log
    joined, scores = len(relations.first), relation_scores(relations, log, solved)
    text = (
        f"relations of {options.relations}: {joined:,} of {joined + dropped:,} join the scans, "
        f"within {TOLERANCE:g} s; errors, mean ± standard deviation:\n{_score_text(scores)}"
    )
    if laser_log.odometry_is_poses(log):
        text += (
            "\nraw odometry is that of the poses in the file: if these are corrected, the errors "
            "are not those of laser SLAM; --odometry FILE gives the odometry of the wheels"
        )
    entry: Json = {
        "file": options.relations,
        "relations in the file": joined + dropped,
        "joined": joined,
        "not joined": dropped,
        "tolerance [s]": TOLERANCE,
        **scores,
    }
    return laser_log.Job(summary, files, text, {"relations": entry}, drawings)


def result_files(solved: Solved) -> Files:
    """The files of a result by name, without figures.

    | file | content |
    |---|---|
    | `trajectory.csv`, `trajectory.tum` | the pose of every scan, the first with its covariance |
    | `graph.g2o` | the optimized graph of keyframes |
    | `loops.csv` | every candidate of a loop, with its outcome |
    | `map.yaml`, `map.pgm` | the map, as ROS has it |
    """
    count = len(solved.time)
    path = Estimate(  # without landmarks
        pose=solved.poses,
        pose_cov=solved.cov,
        points=np.zeros((count, 0, 2)),
        point_covs=np.zeros((count, 0, 2, 2)),
        alive=np.zeros((count, 0), bool),
        tag=np.zeros((count, 0), int),
    )
    loops = [
        [
            str(int(first)),
            str(int(second)),
            *(f"{value:.9g}" for value in z),
            f"{score:.4f}",
            "appearance" if looks else "place",
            LoopOutcome(int(outcome)).name.lower(),
        ]
        for first, second, z, _, score, looks, outcome in zip(*solved.loops, strict=True)
    ]
    head = ["first", "second", "x [m]", "y [m]", "theta [rad]", "inliers", "found by", "outcome"]
    return {
        "trajectory.csv": report.trajectory_csv(solved.time, path),
        "trajectory.tum": report.trajectory_tum(solved.time, path),
        # Without its gauge, pose 0: GTSAM's readG2o does not read the line FIX.
        "graph.g2o": g2o.text_of(
            solved.graph._replace(fixed_pose=np.zeros_like(solved.graph.fixed_pose))
        ),
        "loops.csv": csv_text(head, loops),
        **ros_map.map_files("map", solved.map),
    }


def figures(
    solved: Solved, formats: tuple[str, ...], corrected: Float[np.ndarray, "K 3"] | None
) -> Drawings:
    """`map_before`, `map_after` (maps of laser odometry alone, and of the optimum) and `graph`.

    corrected: poses of reference, if there are some, drawn beside both paths in `graph`.
    """
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._style import pictures

    grid = partial(plot.grid_figure, width=plot.PAGE)
    makers = {
        "map_before": lambda: grid(
            solved.map_before, poses=solved.odometry, title="Laser odometry, before closing"
        ),
        "map_after": lambda: grid(solved.map, poses=solved.poses, title="After closing"),
        "graph": lambda: plot.loops_figure(solved, corrected),
    }

    def files_of(name: str) -> Files:
        return {**pictures(name, makers[name](), formats)}

    return {name: partial(files_of, name) for name in makers}


def film(log: LaserLog, solved: Solved, settings: Settings) -> "Film":
    """The film of a map that grows by laser odometry alone, and of the map after closing."""
    from jaxslam.results.plot._grid_figures import map_film  # matplotlib is slow to load

    maps, until = growing_maps(log, solved.odometry, settings, others=[solved.poses])
    closed, _ = growing_maps(log, solved.poses, settings, others=[solved.odometry])
    kept = int((solved.loops.outcome == LoopOutcome.KEPT).sum())
    last = [closed[-1]] * FINAL_FRAMES
    paths = [solved.odometry[:end] for end in until] + [solved.poses] * FINAL_FRAMES
    captions = [f"laser odometry, scan {end:,} of {until[-1]:,}" for end in until]
    captions += [f"after closing by {kept:,} loops"] * FINAL_FRAMES
    return map_film(
        [np.asarray(grid.log_odds) for grid in (*maps, *last)],
        np.asarray(maps[0].origin),
        float(maps[0].resolution),
        paths,
        captions,
        title=log.name,
    )


def result_summary(solved: Solved) -> dict[str, object]:
    """The numbers of a result, for the table that is printed and for `summary.json`."""
    residuals = "none: without a loop nothing contradicts the matches"
    if solved.dof > 0:
        ratio = float(np.sqrt(solved.chi2 / solved.dof))
        times, relation = (ratio, "larger") if ratio > 1 else (1 / max(ratio, 1e-9), "smaller")
        size = f"{times:.1f} times {relation} than" if times > 1.05 else "as large as"
        residuals = (
            f"{size} the σ of its edges; the covariance of the path is tested by a true path only"
        )
    return {
        **solved.counts,
        "chi2": solved.chi2,
        "degrees of freedom": solved.dof,
        "chi2 / degrees of freedom": solved.chi2 / solved.dof if solved.dof > 0 else None,
        "residuals of the graph": residuals,
        **laser_log.map_size(solved.map),
        **{f"seconds, {stage}": round(value, 2) for stage, value in solved.seconds.items()},
    }


def _scores(log: LaserLog, solved: laser_slam.Solved) -> dict[str, object]:
    """Errors of relations, ATE, and the number of correct loops, by the poses in the file."""
    paths = {"raw odometry": solved.raw, "laser odometry": solved.odometry, "": solved.poses}
    scores: dict[str, object] = {}
    try:
        for name, path in paths.items():
            errors = np.concatenate(
                [metrics.rpe(log.corrected, path, metres=m).translation for m in METRES]
            )
            if not len(errors):
                raise ValueError(f"the path is shorter than {METRES[0]:g} m")
            suffix = f", {name}" if name else ""
            scores[f"mean relation error to 10 m [m]{suffix}"] = float(errors.mean())
        ate = metrics.ate(log.corrected, solved.poses).translation
    except ValueError as problem:
        return {"score": f"none: {problem}"}
    closure = laser_slam.closure_score(solved, log.corrected)
    scores["ATE, RMSE [m]"] = float(np.sqrt((ate**2).mean()))
    scores["loops kept that agree with the poses in the file"] = closure.correct
    if closure.revisits:
        scores["recall of revisits"] = closure.recall
    return scores


def read_relations(path: str, log: LaserLog) -> tuple[metrics.Relations, int]:
    """The relations of a file by rows of the log, and the number without a scan at a stamp.

    Raises ValueError, with the file, if `relation_file` does or if no relation has its scans.
    """
    file = relation_file(path)
    try:
        return metrics.relations_at_stamps(
            log.time, file.first, file.second, file.pose, tolerance=TOLERANCE
        )
    except InvalidField as problem:
        raise ValueError(f"--relations: {file.source}: {problem.reason}") from problem


def relation_scores(relations: metrics.Relations, log: LaserLog, solved: Solved) -> dict[str, Json]:
    """Scores of all relations, and of those whose scans are far apart."""
    nees = laser_slam.relation_nees(solved, *relations)
    apart = np.abs(log.time[relations.second] - log.time[relations.first])
    paths = {
        "laser SLAM": solved.poses,
        "laser odometry": solved.odometry,
        "raw odometry": solved.raw,
    }
    scores: dict[str, Json] = {}
    for name, chosen in (("all", apart >= 0), (f"over {FAR_APART:g} s apart", apart > FAR_APART)):
        subset = metrics.Relations(*(field[chosen] for field in relations))
        count, unknown = len(subset.first), int(np.isnan(nees[chosen]).sum())
        inside = int((nees[chosen] <= chi2_quantile(ELLIPSE_SHARE, 3)).sum())
        figures: Json = {}
        for path_name, path in paths.items() if count else ():
            by_quantity = metrics.benchmark_figures(metrics.relation_errors(subset, path))
            figures[path_name] = {
                quantity: figure._asdict() for quantity, figure in by_quantity.items()
            }
        scores[name] = {
            "relations": count,
            **figures,
            "in the 95 % ellipse": inside,
            "without a covariance": unknown,  # of a scan and itself
            "share in the 95 % ellipse": inside / (count - unknown) if count > unknown else None,
        }
    return scores


def _score_text(scores: Mapping[str, Json]) -> str:
    """The scores as text: a row for each path, a column for each quantity."""
    columns: dict[str, dict[str, object]] = {}
    lines = []
    for name, score in scores.items():
        for path, figures in score.items():
            for quantity, figure in figures.items() if isinstance(figures, dict) else ():
                cell = f"{_decimals(figure['mean'])} ± {_decimals(figure['std'])}"
                columns.setdefault(quantity, {})[f"{name}, {path}"] = cell
        line = f"{name}: {score['relations']:,} relations"
        share = score["share in the 95 % ellipse"]
        if isinstance(share, float):
            line += f", {100 * share:.1f} % in the 95 % ellipse of the graph's covariance"
            if unknown := score["without a covariance"]:
                line += f", {unknown:,} without a covariance"
        lines.append(line)
    return "\n".join([summary_table(columns), *lines])


def _decimals(value: float) -> str:
    """A number with four decimals, from 10 on with one."""
    return f"{value:.4f}" if value < 10 else f"{value:,.1f}"
