"""`jaxslam run --relations FILE`: the Freiburg benchmark of laser SLAM."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.cli.common import summary_table
from jaxslam.consistency import metrics
from jaxslam.datasets import LaserLog, relation_file
from jaxslam.laser import laser_slam
from jaxslam.math.stats import chi2_quantile
from jaxslam.results.files import Json

TOLERANCE = 1e-4
"""[s] within which a stamp of a relation is that of a scan: public files print five decimals, and
times since 1970 have 2e-7 s in float64."""
APART = 60.0
"""[s] beyond which the scans of a relation are far apart."""
SHARE = 0.95
"""Of the relations in the ellipse of the covariance, if it is right and the relations exact."""


class GivenRelations(NamedTuple):
    """The relations of a file between the scans of a log."""

    joined: metrics.Relations
    """R relations by the rows of the log"""
    apart: Float[np.ndarray, "R"]
    """[s] between the scans of each"""
    dropped: int
    """relations of the file without a scan at one of their stamps"""
    source: str
    """the file"""


class Score(NamedTuple):
    """What some of the relations say of a result."""

    size: int
    figures: dict[str, dict[str, metrics.MeanAndStd]]
    """by path and quantity; empty without relations"""
    inside: int
    """relations in the ellipse of the graph's covariance"""
    unknown: int
    """relations without a covariance: of a scan and itself"""

    @property
    def share(self) -> float | None:
        """Of those with a covariance, in the ellipse."""
        known = self.size - self.unknown
        return self.inside / known if known else None


def given_relations(path: str, log: LaserLog) -> GivenRelations:
    """The relations of a file between the scans of a log.

    Raises ValueError, with the file, on what `relation_file` refuses, and where none joins.
    """
    told = relation_file(path)
    try:
        joined, dropped = metrics.given(
            log.time, told.first, told.second, told.pose, tolerance=TOLERANCE
        )
    except ValueError as problem:
        reason = str(problem).removeprefix("given: ")
        raise ValueError(f"--relations: {told.source}: {reason}") from problem
    apart = np.abs(log.time[joined.second] - log.time[joined.first])
    return GivenRelations(joined, apart, dropped, told.source)


def scores_of(given: GivenRelations, solved: laser_slam.Solved) -> dict[str, Score]:
    """The scores of all relations, and of those whose scans are far apart."""
    nees = laser_slam.relation_nees(solved, *given.joined)
    paths = {
        "laser SLAM": solved.poses,
        "laser odometry": solved.odometry,
        "raw odometry": solved.raw,
    }
    out = {}
    far = given.apart > APART
    for name, chosen in (("all", np.ones_like(far)), (f"over {APART:g} s apart", far)):
        some = metrics.Relations(*(field[chosen] for field in given.joined))
        count, found = len(some.first), nees[chosen]
        errors = {path: metrics.relation_errors(some, at) for path, at in paths.items()}
        out[name] = Score(
            count,
            {path: metrics.benchmark_figures(of) for path, of in errors.items()} if count else {},
            int((found <= chi2_quantile(SHARE, 3)).sum()),
            int(np.isnan(found).sum()),
        )
    return out


def score_entries(given: GivenRelations, scores: Mapping[str, Score]) -> Json:
    """The entry of `summary.json`."""
    joined = len(given.apart)
    out: Json = {
        "file": given.source,
        "relations in the file": joined + given.dropped,
        "joined": joined,
        "not joined": given.dropped,
        "tolerance [s]": TOLERANCE,
    }
    for name, score in scores.items():
        by_path = {
            path: {quantity: of._asdict() for quantity, of in figures.items()}
            for path, figures in score.figures.items()
        }
        out[name] = {
            "relations": score.size,
            **by_path,
            "in the 95 % ellipse": score.inside,
            "without a covariance": score.unknown,
            "share in the 95 % ellipse": score.share,
        }
    return out


def score_text(given: GivenRelations, scores: Mapping[str, Score]) -> str:
    """The scores as they are printed: a row for each path, a column for each quantity."""
    columns: dict[str, dict[str, object]] = {}
    lines = []
    for name, score in scores.items():
        for path, figures in score.figures.items():
            for quantity, (mean, std) in figures.items():
                cell = f"{_shown(mean)} ± {_shown(std)}"
                columns.setdefault(quantity, {})[f"{name}, {path}"] = cell
        if score.share is None:
            lines.append(f"{name}: {score.size:,} relations")
        else:
            without = f", {score.unknown:,} without a covariance" if score.unknown else ""
            lines.append(
                f"{name}: {score.size:,} relations, {100 * score.share:.1f} % in the 95 % ellipse "
                f"of the graph's covariance{without}"
            )
    joined = len(given.apart)
    head = (
        f"relations of {given.source}: {joined:,} of {joined + given.dropped:,} join the scans, "
        f"within {TOLERANCE:g} s; errors, mean ± standard deviation:"
    )
    return "\n".join([head, summary_table(columns), *lines])


def _shown(value: float) -> str:
    """Four decimals, one of numbers from 10 on."""
    return f"{value:.4f}" if value < 10 else f"{value:,.1f}"
