"""The command `jaxslam map`: a map of a laser log at the poses in the file."""

import argparse
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Float

from jaxslam._cli.campaigns.piecewise import padded_rows
from jaxslam._cli.recorded import laser_log
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core.types import Beams, Estimate
from jaxslam.datasets import LaserLog
from jaxslam.datasets import _ros_map as ros_map
from jaxslam.laser import grids
from jaxslam.laser.grids import Counts
from jaxslam.math import numpy_poses as poses
from jaxslam.results import report
from jaxslam.results._files import Files

SCANS_AT_ONCE = 64
"""Number of scans that one call of the compiled program counts, between updates of the progress."""

MARGIN = 1.0
"""Distance from the outermost hit to the border of the map [m]."""

MAX_CELLS = 10**8
"""Largest number of cells of a map."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `jaxslam map`."""
    laser_log.add_options(parser, run_mapping)


def run_mapping(log: LaserLog, options: argparse.Namespace) -> laser_log.Job:
    """The map of the scans at the poses in the file: counts of hits and misses, as log-odds.

    A beam without a return is not used. The written path is that of the robot.
    """
    from jaxslam.results import plot  # matplotlib is slow to load
    from jaxslam.results.plot._style import pictures

    laser_log.check_poses(log)
    shape, origin = map_frame(log, options.resolution)
    with Progress(f"{log.name}, map", "scans") as progress:
        counts = count_beams(log, shape, origin, options.resolution, progress)
    grid = jax.device_get(grids.occupancy(counts))
    zero = np.zeros((len(log.time), 3, 3))
    path = Estimate(log.corrected, zero, *[np.zeros(0)] * 4)

    def draw() -> Files:
        title = f"{log.name}: {len(log.time):,} scans at known poses"
        figure = plot.grid_figure(grid, poses=log.corrected, width=plot.PAGE, title=title)
        return {**pictures("map", figure, options.figures)}

    files: Files = {
        **ros_map.map_files("map", grid),
        "trajectory.csv": report.trajectory_csv(log.time, path),
        "trajectory.tum": report.trajectory_tum(log.time, path),
    }
    is_known = np.asarray(grid.observed)
    bits = np.asarray(grids.entropy(grid))[is_known]
    summary = {
        "job": "map from the poses in the file",
        "beams": {
            "in the map": int(counts.hits.sum()),
            "met nothing": int(log.beams.returns(log.max_range)[1].sum()),
            "without a range, or padding": int(counts.unusable),
        },
        **laser_log.map_size(grid),
        "cells known": int(is_known.sum()),
        "cells occupied": int((np.asarray(grid.log_odds) > 0).sum()),
        "mean entropy of a known cell [bit]": float(bits.mean()),
        "entropy of the map [bit]": float(bits.sum() + (~is_known).sum()),
    }
    return laser_log.Job(summary, files, drawings={"map": draw})


def map_frame(log: LaserLog, resolution: float) -> tuple[tuple[int, int], Float[np.ndarray, "3"]]:
    """The shape (H, W) and the origin of a map that covers all poses and hits.

    Raises ValueError if no beam returns, and on more than `MAX_CELLS` cells.
    """
    ranges, angles = np.asarray(log.beams.range), np.asarray(log.beams.angle)
    pose = poses.compose(log.corrected, log.mount)  # of the laser
    heading = pose[:, 2:] + angles
    ends = pose[:, None, :2] + ranges[..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    met, _ = log.beams.returns(log.max_range)
    if not met.any():
        raise ValueError(
            f"{log.source}: no beam returns within {log.max_range:g} m (--max-range), so there is "
            "no map"
        )
    places = np.concatenate([log.corrected[:, :2], pose[:, :2], ends[met]])
    low = resolution * np.floor((places.min(axis=0) - MARGIN) / resolution)
    size = np.ceil((places.max(axis=0) + MARGIN - low) / resolution)
    if not size.prod() <= MAX_CELLS:
        raise ValueError(
            f"--resolution: cells of {resolution:g} m make a map of {size[0]:,.0f} × {size[1]:,.0f}"
            f" cells; at most {MAX_CELLS:,}"
        )
    return (int(size[1]), int(size[0])), np.array([*low, 0.0])


def count_beams(
    log: LaserLog,
    shape: tuple[int, int],
    origin: Float[np.ndarray, "3"],
    resolution: float,
    progress: Callable[[int, int], object],
) -> Counts:
    """The counts of all scans at the poses in the file; scans without a valid beam are skipped.

    `SCANS_AT_ONCE` scans at a time, padded by scans without a valid beam.
    """
    total, width = np.shape(log.beams.range)
    hits, misses = np.zeros((2, *shape), np.int32)
    outside = unusable = 0
    for begin in range(0, total, SCANS_AT_ONCE):
        rows = slice(begin, begin + SCANS_AT_ONCE)
        beams = Beams(*(padded_rows(part[rows], SCANS_AT_ONCE) for part in log.beams))
        padding = width * (SCANS_AT_ONCE - len(log.time[rows]))
        unusable += int((~np.asarray(beams.valid)).sum()) - padding
        if beams.valid.any():
            counts = grids.count(
                shape,
                origin,
                resolution,
                padded_rows(log.corrected[rows], SCANS_AT_ONCE),
                beams,
                max_range=log.max_range,
                no_return=0.0,
                mount=log.mount,
            )
            hits += np.asarray(counts.hits)
            misses += np.asarray(counts.misses)
            outside += int(counts.outside)
        progress(min(begin + SCANS_AT_ONCE, total), total)
    sums = np.array(outside), np.array(unusable)
    return Counts(hits, misses, origin, np.array(resolution), *sums)
