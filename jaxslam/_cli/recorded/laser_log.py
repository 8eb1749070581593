"""Shared by the commands on a laser log: options, selection of scans, writing of results."""

import argparse
import dataclasses
import math
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam import datasets
from jaxslam._cli import cache
from jaxslam._cli.common import (
    FILMS,
    SUMMARY,
    Drawings,
    add_dtype,
    add_figures,
    add_out,
    check_out,
    summary_table,
    write_results,
)
from jaxslam.core.validation import require
from jaxslam.datasets import LaserLog
from jaxslam.datasets._laser_logs.bag_messages import is_bag
from jaxslam.laser.grids import Grid
from jaxslam.math._odometry_jumps import odometry_jumps
from jaxslam.results._campaign_files import FORMATS, formats_of_figures
from jaxslam.results._files import Files, Json, json_text, versions


class Job(NamedTuple):
    """The result of a command, to print and to write."""

    summary: Json
    """entries of the summary"""
    files: Files
    text: str = ""
    """printed below the summary"""
    details: Json | None = None
    """further entries of `summary.json`, which `text` already shows"""
    drawings: Drawings | None = None


READERS: dict[str, Callable[..., LaserLog]] = {
    "carmen": lambda path, laser, **options: datasets.carmen(path, laser=laser, **options),
    "rosbag": lambda path, laser, **options: datasets.rosbag(path, laser, **options),
}
"""Readers of laser logs by `--dataset`, of the path and the laser, with the same options."""

Work = Callable[[LaserLog, argparse.Namespace], Job]
"""Computes the result of a command; `options.figures` are the formats of figures."""


def add_options(parser: argparse.ArgumentParser, work: Work, *, map_is_made: bool = True) -> None:
    """Add the options of a command on a laser log.

    map_is_made: add `--resolution`, of the map that the command makes.
    """
    parser.add_argument(
        "path",
        metavar="FILE",
        help="the log: a file of CARMEN, or a ROS bag (.bag, .mcap, .db3, the folder of ROS 2, or "
        "a folder with the parts NAME_0.bag, NAME_1.bag, … of a recording)",
    )
    parser.add_argument(
        "--dataset",
        choices=tuple(READERS),
        help="format of the log (default: rosbag for a folder and for .bag, .mcap and .db3)",
    )
    parser.add_argument(
        "--list",
        action="store_true",
        help="print the topics of a ROS bag, its time, frames and mounts of its lasers, and stop",
    )
    if map_is_made:
        parser.add_argument(
            "--resolution",
            type=float,
            metavar="M",
            default=0.05,
            help="side of a cell of the map that is made [m] (default: 0.05)",
        )
    parser.add_argument(
        "--max-range",
        type=float,
        metavar="M",
        default=50.0,
        help="ranges from this one, or from the maximum in the log, are without a return [m] "
        "(default: 50)",
    )
    parser.add_argument(
        "--every",
        type=int,
        metavar="N",
        default=1,
        help="use each n-th scan (default: 1)",
    )
    parser.add_argument(
        "--scans",
        metavar="A:B",
        default=":",
        help="use scans A to B - 1, counted from 0; :455 is the first 455 (default: all)",
    )
    parser.add_argument(
        "--laser",
        metavar="KIND",
        help="lines of the laser to read: FLASER, RLASER, ROBOTLASER1, RAWLASER1, … (default: the "
        "one with poses and most scans); of a bag the topic (default: the only one)",
    )
    parser.add_argument(
        "--odometry",
        metavar="FILE",
        help="raw odometry, lines t x y heading [s, m, m, rad], in place of the log's; of a bag "
        "the topic, or two frames odom:base_link (default: the only one, else frames that move)",
    )
    parser.add_argument(
        "--mount",
        metavar="X,Y,HEADING",
        help="pose of the laser on the robot [m, m, deg] (default: that of the log)",
    )
    add_figures(parser, FORMATS)
    cache.add_options(parser)
    add_dtype(parser)
    add_out(parser)
    parser.set_defaults(command=partial(run_job, work))


def run_job(work: Work, options: argparse.Namespace, command: str) -> int:
    """Read the log, print and write the result of a command; returns the exit status."""
    began = time.perf_counter()
    for name in ("resolution", "max_range", "every", "particles"):
        value = getattr(options, name, 1)
        if not 0 < value < math.inf:
            raise ValueError(f"--{name.replace('_', '-')}: expected a number above 0, got {value}")
    options.figures = require("--figures", options.figures.split(","), formats_of_figures)
    if options.list:
        print(bag_text(options.path))
        return 0
    log, left_out = read_log(options)
    check_out(options.out, command.split()[1])
    job = work(log, options)
    x, y, heading = map(float, log.mount)
    mount = {"mount of the laser [m, m, deg]": [x, y, float(np.rad2deg(heading))]}
    summary: Json = {
        "dataset": log.name,
        "source": log.source,
        "command": command,
        "dtype": options.dtype,
        "scans": len(log.time),
        "scans left out": left_out,
        "dropped by the reader": dict(log.dropped),
        "corrections to the data": list(log.corrections),
        **(mount if log.mount.any() else {}),
        **job.summary,
        "seconds": round(time.perf_counter() - began, 2),
    }
    print(summary_table({"": summary}))
    if job.text:
        print("\n" + job.text)
    text = json_text(summary | (job.details or {}) | {"versions": versions()})
    return write_results(options.out, job.files | {SUMMARY: text}, job.drawings or {}, FILMS)


def read_log(options: argparse.Namespace) -> tuple[LaserLog, dict[str, int]]:
    """The scans that the options select, and the number left out by reason.

    Raises ValueError, with the file, if no scan is left or none has a valid beam.
    """
    mount = None if options.mount is None else pose_of("--mount", options.mount)
    log = READERS[options.dataset or ("rosbag" if is_bag(options.path) else "carmen")](
        options.path,
        options.laser,
        odometry=options.odometry,
        max_range=options.max_range,
        mount=mount,
    )
    total = len(log.time)
    ends = options.scans.split(":")
    try:
        if len(ends) != 2:
            raise ValueError
        bounds = slice(*(int(end) if end.strip() else None for end in ends))
    except ValueError:
        raise ValueError(
            f"--scans: expected A:B, two numbers of scans, got {options.scans!r}"
        ) from None
    first, last, _ = bounds.indices(total)
    last = max(first, last)
    keep = np.arange(first, last)[:: options.every]
    if not len(keep):
        raise ValueError(f"--scans: {options.scans} has none of the {total} scans of {log.source}")
    # Odometry between two selected scans is known if that of any step between them is, and none
    # is a jump. Differences of running sums count the steps between two scans.
    odometry_known = np.diff(np.cumsum(log.odometry_known)[keep], prepend=-1) > 0
    jumps = np.cumsum(odometry_jumps(log.raw, log.time))[keep]
    odometry_known &= np.diff(jumps, prepend=jumps[:1]) == 0
    log = dataclasses.replace(
        log,
        **{name: getattr(log, name)[keep] for name in ("time", "corrected", "raw", "row")},
        odometry_known=odometry_known,
        beams=type(log.beams)(*(part[keep] for part in log.beams)),
    )
    blind = int((~np.asarray(log.beams.valid).any(axis=1)).sum())
    if blind == len(keep):
        raise ValueError(f"{log.source}: none of {blind} scans has a valid beam")
    return log, {
        "outside --scans": total - (last - first),
        "skipped by --every": last - first - len(keep),
        "without a valid beam": blind,
    }


def bag_text(path: str) -> str:
    """The contents of a ROS bag: topics, time of the recording, mounts."""
    bag = datasets.rosbag_contents(path)
    columns: dict[str, Json] = {
        "type": {topic.name: topic.type for topic in bag.topics},
        "messages": {topic.name: topic.count for topic in bag.topics},
    }
    lines = [summary_table(columns)]
    if bag.start < bag.end:
        lines.append(
            f"recorded from {bag.start:.3f} s to {bag.end:.3f} s: {bag.end - bag.start:.3f} s"
        )
    lines += [f"mount of {topic}: {mount}" for topic, mount in bag.lasers.items()]
    lines += [f"odometry {pair}: {count:,} transforms" for pair, count in bag.odometry.items()]
    lines += [f"frames {pair}: {text}" for pair, text in bag.frames.items()]
    lines += bag.notes
    return "\n".join(lines)


def check_poses(log: LaserLog) -> None:
    """Raise ValueError if the scans of a log have no poses."""
    if not log.placed:
        raise ValueError(f"{log.source}: expected scans with poses, and {log.laser} has none")


def pose_of(option: str, text: str, others: str = "") -> Float[np.ndarray, "3"]:
    """The pose (3,) of X,Y,HEADING [m, m, deg]."""
    try:
        pose = np.array([float(field) for field in text.split(",")])
    except ValueError:
        pose = np.zeros(0)
    if pose.shape != (3,) or not np.all(np.isfinite(pose)):
        raise ValueError(f"{option}: expected {others}X,Y,HEADING [m, m, deg], got {text!r}")
    pose[2] = np.angle(np.exp(1j * np.deg2rad(pose[2])))
    return pose


def score_or_reason(log: LaserLog, score: Callable[[], Json]) -> Json:
    """The score by the poses in the file; without poses, or equal ones, the reason for none."""
    if not log.placed:
        return {"score": "none: the file has no poses"}
    if odometry_is_poses(log):
        return {"score": "none: the odometry is equal to the poses that would score it"}
    return score()


def odometry_is_poses(log: LaserLog) -> bool:
    """Whether raw odometry equals the poses of the scans, as in a file without ODOM lines."""
    return log.placed and bool(np.allclose(log.raw, log.corrected, rtol=0, atol=1e-6))


def map_size(grid: Grid) -> dict[str, object]:
    """The size of a map: entries of the summary."""
    height, width = grid.log_odds.shape
    return {
        "map, cells wide": width,
        "map, cells high": height,
        "resolution [m]": float(grid.resolution),
    }
