"""`jaxslam run` on a laser log without --map or --localize: laser SLAM."""

import argparse

import numpy as np

from jaxslam.cli.films import film_files
from jaxslam.cli.laser.job import Job, scored
from jaxslam.cli.laser.relations import given_relations, score_entries, score_text, scores_of
from jaxslam.consistency import metrics
from jaxslam.consistency.campaign.progress import Progress
from jaxslam.datasets import LaserLog
from jaxslam.laser import laser_slam
from jaxslam.results import laser_slam as results
from jaxslam.results.files import Json

METRES = (1.0, 2.0, 5.0, 10.0)
"""Lengths of path of the relations that score the result."""


def run_slam(log: LaserLog, options: argparse.Namespace) -> Job:
    """Path, graph, loops and map from raw odometry and scans; the poses in the file score them,
    and the relations of another file."""
    given = None if options.relations is None else given_relations(options.relations, log)
    settings = laser_slam.Settings(resolution=options.resolution)
    solved = _solved(log, settings)
    files = results.result_files(solved)
    if options.animate:
        made = results.film(log, solved, settings, title=log.name)
        files |= film_files({"slam": made}, suffixed=False)
    told = ""
    more: Json = {}
    if given is not None:
        scores = scores_of(given, solved)
        told, more = score_text(given, scores), {"relations": score_entries(given, scores)}
    return Job(
        results.result_summary(solved) | scored(log, lambda: _scores(log, solved)),
        files,
        lambda formats: results.figures(solved, formats, log.corrected),
        told,
        more,
    )


def _solved(log: LaserLog, settings: laser_slam.Settings) -> laser_slam.Solved:
    """The result, with a bar of progress for each stage."""
    with Progress(f"{log.name}, reading", "scans") as first:
        bars = {"": first}

        def tell(stage: str, done: int, of: int) -> None:
            if stage not in bars:
                unit = "candidates" if stage == "loop closing" else "scans"
                bars[stage] = Progress(f"{log.name}, {stage}", unit)
            bars[stage](done, of)

        return laser_slam.solve(log, settings, progress=tell)


def _scores(log: LaserLog, solved: laser_slam.Solved) -> dict[str, object]:
    """Errors of relations, ATE, and which loops are right, by the poses in the file."""
    paths = {"raw odometry": solved.raw, "laser odometry": solved.odometry, "": solved.poses}
    out: dict[str, object] = {}
    try:
        for name, path in paths.items():
            found = [metrics.rpe(log.corrected, path, metres=m) for m in METRES]
            every = np.concatenate([each.translation for each in found])
            if not len(every):
                raise ValueError(f"the path is shorter than {METRES[0]:g} m")
            what = "mean relation error to 10 m [m]" + (f", {name}" if name else "")
            out[what] = float(every.mean())
        ate = metrics.ate(log.corrected, solved.poses).translation
    except ValueError as problem:
        return {"score": f"none: {problem}"}
    score = laser_slam.closure_score(solved, log.corrected)
    out["ATE, RMSE [m]"] = float(np.sqrt((ate**2).mean()))
    out["loops kept that agree with the poses in the file"] = score.correct
    if score.revisits:
        out["recall of revisits"] = score.recall
    return out
