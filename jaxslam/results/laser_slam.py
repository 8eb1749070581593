"""Results of laser SLAM as files: path, graph, map, pictures, summary."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.types import Estimate
from jaxslam.datasets import g2o
from jaxslam.laser.grids import Grid, write_map
from jaxslam.laser.laser_slam import LoopOutcome, Settings, Solved
from jaxslam.laser.laser_slam.mapping import growing_maps
from jaxslam.laser.laser_slam.records import LogOfScans
from jaxslam.results import report
from jaxslam.results.files import Files, csv_text

if TYPE_CHECKING:  # Pillow and Matplotlib are slow to load
    from jaxslam.results.plot import Film
    from jaxslam.results.plot.style import Figure

HELD = 12
"""Frames of a film that show the map after closing."""


def result_files(solved: Solved) -> Files:
    """What `results.files.write_files` writes of a result, by name; without figures.

    | file | content |
    |---|---|
    | `trajectory.csv`, `trajectory.tum` | the pose of every scan, the first with its covariance |
    | `graph.g2o` | the optimized graph of keyframes |
    | `loops.csv` | every loop that was tried, with its outcome |
    | `map.yaml`, `map.pgm` | the map, as ROS has it |
    """
    path = _estimate(solved)
    return {
        "trajectory.csv": report.trajectory_csv(solved.time, path),
        "trajectory.tum": report.trajectory_tum(solved.time, path),
        "graph.g2o": g2o.text_of(solved.graph),
        "loops.csv": _loops_csv(solved),
        "map.yaml": lambda target: write_map(target, solved.map),
        "map.pgm": lambda target: None,  # written with its header
    }


def figures(
    solved: Solved, formats: tuple[str, ...] = ("png",), corrected: ArrayLike | None = None
) -> Files:
    """`map_before`, `map_after` (maps of laser odometry alone, and of the optimum) and `graph`.

    corrected: (K, 3) poses of reference, drawn beside both paths in `graph`.
    """
    from jaxslam.results import plot  # matplotlib is slow to load

    reference = None if corrected is None else np.asarray(corrected, float)
    pictures = {
        "map_before": lambda: plot.grid_figure(
            solved.map_before,
            poses=solved.odometry,
            title="Laser odometry, before closing",
            width=plot.PAGE,
        ),
        "map_after": lambda: plot.grid_figure(
            solved.map, poses=solved.poses, title="After closing", width=plot.PAGE
        ),
        "graph": lambda: plot.loops_figure(solved, reference),
    }

    def drawn(make: Callable[[], "Figure"], kind: str) -> Callable[[Path], object]:
        return lambda path: path.write_bytes(plot.encode(make(), kind))

    return {
        f"{name}.{kind}": drawn(make, kind) for name, make in pictures.items() for kind in formats
    }


def film(log: LogOfScans, solved: Solved, settings: Settings, *, title: str = "") -> "Film":
    """The film of a map that grows by laser odometry alone, and of the map after closing.

    Arguments are those of `laser_slam.solve` and its result.
    """
    from jaxslam.results import plot  # matplotlib is slow to load

    maps, until = growing_maps(log, solved.odometry, settings, others=[solved.poses])
    closed, _ = growing_maps(log, solved.poses, settings, others=[solved.odometry])
    kept = int((solved.loops.outcome == LoopOutcome.KEPT).sum())
    last = [closed[-1]] * HELD
    paths = [solved.odometry[:end] for end in until] + [solved.poses] * HELD
    said = [f"laser odometry, scan {end:,} of {until[-1]:,}" for end in until]
    said += [f"after closing by {kept:,} loops"] * HELD
    scene = plot.map_scene(
        [np.asarray(one.log_odds) for one in (*maps, *last)],
        np.asarray(maps[0].origin),
        float(maps[0].resolution),
        paths,
        said,
        title=title,
    )
    return plot.Film(scene)


def result_summary(solved: Solved) -> dict[str, object]:
    """The numbers of a result, for the table that is printed and for `summary.json`."""
    return {
        **solved.counts,
        "chi2": solved.chi2,
        "degrees of freedom": solved.dof,
        "chi2 / degrees of freedom": solved.chi2 / solved.dof if solved.dof > 0 else None,
        "covariances": _verdict(solved),
        **map_size(solved.map),
        **{f"seconds, {stage}": round(value, 2) for stage, value in solved.seconds.items()},
    }


def map_size(grid: Grid) -> dict[str, object]:
    """The size of a map: entries of the summary."""
    height, width = grid.log_odds.shape
    return {
        "map, cells wide": width,
        "map, cells high": height,
        "resolution [m]": float(grid.resolution),
    }


def _verdict(solved: Solved) -> str:
    """What χ² says of the covariances of matches."""
    if solved.dof <= 0:
        return "no loop tests them"
    ratio = solved.chi2 / solved.dof
    if 0.5 <= ratio <= 2:
        return "consistent with χ² within a factor of 2"
    if ratio > 2:
        return f"overconfident: σ too small by a factor of {np.sqrt(ratio):.1f}"
    return f"underconfident: σ too large by a factor of {1 / np.sqrt(ratio):.1f}"


def _estimate(solved: Solved) -> Estimate:
    """The path as an estimate without landmarks."""
    count = len(solved.time)
    return Estimate(
        pose=solved.poses,
        pose_cov=solved.cov,
        points=np.zeros((count, 0, 2)),
        point_covs=np.zeros((count, 0, 2, 2)),
        alive=np.zeros((count, 0), bool),
        tag=np.zeros((count, 0), int),
    )


def _loops_csv(solved: Solved) -> str:
    loops = solved.loops
    rows = [
        [
            str(int(first)),
            str(int(second)),
            *(f"{value:.9g}" for value in z),
            f"{score:.4f}",
            "appearance" if looks else "place",
            LoopOutcome(int(outcome)).name.lower(),
        ]
        for first, second, z, _, score, looks, outcome in zip(*loops, strict=True)
    ]
    head = ["first", "second", "x [m]", "y [m]", "theta [rad]", "inliers", "found by", "outcome"]
    return csv_text(head, rows)
