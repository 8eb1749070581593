"""The options of `jaxslam run` for a laser log, and the log that they ask for."""

import argparse
import dataclasses
import math
import re

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam import datasets
from jaxslam.datasets import LaserLog

READERS = {"carmen": datasets.carmen}
"""Readers of laser logs by name; each takes (path, max_range=…, laser=…, odometry=…, mount=…)."""

DEFAULTS: dict[str, object] = {
    "resolution": 0.05,
    "max_range": 50.0,
    "every": 1,
    "scans": ":",
    "start": "file",
    "particles": 2000,
    "seed": 0,
}
"""Of the options that have one; an option that is not given is None in the namespace."""

ALONE = ("map", "localize", "laser", "odometry", "mount", "relations", *DEFAULTS)
"""Options that only a laser log has."""

OTHERS = "filters", "gate", "associate", "check_every", "robot"
"""Options that a laser log does not have."""


SIGNED = "--start", "--scans", "--mount"
"""Options whose value may begin with a minus sign, and is no single number."""


def with_signed_values(arguments: list[str]) -> list[str]:
    """The arguments, with `--start=-6,-10,90` in place of `--start -6,-10,90`, and so of `SIGNED`:
    argparse takes such a value for an option."""
    out: list[str] = []
    for argument in arguments:
        if out and out[-1] in SIGNED and re.match(r"-[\d.]", argument):
            out[-1] += f"={argument}"
        else:
            out.append(argument)
    return out


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of laser logs to `jaxslam run`."""
    group = parser.add_argument_group(
        "laser logs", "of --dataset carmen; without --map and --localize: laser SLAM"
    )
    what = group.add_mutually_exclusive_group()
    what.add_argument(
        "--map",
        choices=["known"],
        help="known: make a map from the poses that stand in the file beside the scans",
    )
    what.add_argument(
        "--localize",
        metavar="MAP.yaml",
        help="localize the robot in a map of ROS, from raw odometry and scans",
    )
    for name, kind, metavar, text in (
        ("resolution", float, "M", "side of a cell of the map that is made [m]"),
        (
            "max-range",
            float,
            "M",
            "a range from here on, or from the maximum that the log states, met nothing [m]",
        ),
        ("every", int, "N", "use each n-th scan"),
        ("scans", str, "A:B", "use the scans from number A on and before B; :455 is the first 455"),
        (
            "start",
            str,
            "POSE",
            "where --localize starts: file (the pose beside the first scan), global (anywhere that "
            "is free), or X,Y,HEADING [m, m, deg]",
        ),
        ("particles", int, "N", "largest number of particles of --localize"),
        ("seed", int, "N", "seed of the particles' random numbers"),
    ):
        default = DEFAULTS[name.replace("-", "_")]
        group.add_argument(
            f"--{name}", type=kind, metavar=metavar, help=f"{text} (default: {default})"
        )
    for name, metavar, text in (
        (
            "laser",
            "KIND",
            "lines of the laser to read: FLASER, RLASER, ROBOTLASER1, RAWLASER1, … (default: of "
            "those with poses the one with most scans)",
        ),
        (
            "odometry",
            "FILE",
            "raw odometry, lines t x y heading [s, m, m, rad], in place of the log's",
        ),
        (
            "mount",
            "X,Y,HEADING",
            "pose of the laser on the robot [m, m, deg] (default: that of the log)",
        ),
        (
            "relations",
            "FILE",
            "relative poses between stamps that score laser SLAM, lines t1 t2 x y z roll pitch yaw "
            "[s, m, rad]",
        ),
    ):
        group.add_argument(f"--{name}", metavar=metavar, help=text)


def refuse_laser_options(options: argparse.Namespace) -> None:
    """Raise ValueError if an option of laser logs is given with another data set."""
    given = [name for name in ALONE if getattr(options, name, None) is not None]
    if given:
        name = given[0].replace("_", "-")
        raise ValueError(
            f"--{name}: expected a laser log, --dataset {', '.join(READERS)}: leave it out"
        )


def complete(options: argparse.Namespace) -> argparse.Namespace:
    """The options with their defaults; raises ValueError on what a laser log cannot have."""
    for name in OTHERS:
        if getattr(options, name) is not None:
            raise ValueError(
                f"--{name.replace('_', '-')}: a laser log does not have this option: leave it out"
            )
    if options.animate and (options.map is not None or options.localize is not None):
        raise ValueError(
            "--animate: a laser log has a film of laser SLAM alone: leave out --animate, or --map "
            "and --localize"
        )
    if options.relations is not None and (options.map is not None or options.localize is not None):
        raise ValueError(
            "--relations: relations score laser SLAM alone: leave out --relations, or --map and "
            "--localize"
        )
    for_localization = [
        n for n in ("start", "particles", "seed") if getattr(options, n) is not None
    ]
    if options.localize is None and for_localization:
        raise ValueError(
            f"--{for_localization[0]}: expected --localize MAP.yaml beside it: add it, or leave "
            "this option out"
        )
    if options.localize is not None and options.resolution is not None:
        raise ValueError(
            "--resolution: --localize reads a map, which has its own: leave this option out"
        )
    given = {n: v for n, v in vars(options).items() if v is not None}
    made = argparse.Namespace(**(vars(options) | DEFAULTS | given))
    for name in ("resolution", "max_range", "every", "particles"):
        value = getattr(made, name)
        if not 0 < value < math.inf:
            raise ValueError(f"--{name.replace('_', '-')}: expected a number above 0, got {value}")
    return made


def read_log(options: argparse.Namespace) -> tuple[LaserLog, dict[str, int]]:
    """The scans that the options ask for, and how many are left out, by reason.

    Raises ValueError, with the file, where no scan is left or none has a valid beam.
    """
    log = READERS[options.dataset](
        options.path,
        max_range=options.max_range,
        laser=options.laser,
        odometry=options.odometry,
        mount=None if options.mount is None else _pose("--mount", options.mount),
    )
    total = len(log.time)
    first, last = _interval(options.scans, total)
    keep = np.arange(first, last)[:: options.every]
    if not len(keep):
        raise ValueError(f"--scans: {options.scans} has none of the {total} scans of {log.source}")
    log = dataclasses.replace(
        log,
        **{name: getattr(log, name)[keep] for name in ("time", "corrected", "raw", "row")},
        odometry_known=_known(log.odometry_known, keep),
        beams=type(log.beams)(*(part[keep] for part in log.beams)),
    )
    blind = int((~np.asarray(log.beams.valid).any(axis=1)).sum())
    if blind == len(keep):
        raise ValueError(f"{log.source}: none of {blind} scans has a valid beam")
    left_out = {"outside --scans": total - (last - first), "skipped by --every": last - first}
    left_out["skipped by --every"] -= len(keep)
    return log, left_out | {"without a valid beam": blind}


def _known(known: Bool[np.ndarray, "K"], keep: Int[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
    """Whether raw odometry tells of any of the steps that lie between the scans that are kept."""
    steps = np.cumsum(known)[keep]
    return np.asarray(np.diff(steps, prepend=-1) > 0)


def _interval(text: str, total: int) -> tuple[int, int]:
    """The first scan and the one after the last of A:B, as slices of Python have it."""
    ends = text.split(":")
    try:
        if len(ends) != 2:
            raise ValueError
        first, last = (int(end) if end.strip() else None for end in ends)
    except ValueError:
        raise ValueError(f"--scans: expected A:B, two numbers of scans, got {text!r}") from None
    start, stop, _ = slice(first, last).indices(total)
    return start, max(start, stop)


def check_poses(log: LaserLog) -> None:
    """Raise ValueError where the scans of a log have no poses."""
    if not log.placed:
        raise ValueError(f"{log.source}: expected poses beside the scans, and {log.laser} has none")


def start_pose(text: str, log: LaserLog) -> np.ndarray | None:
    """The pose (3,) at which localization starts; None for anywhere."""
    if text == "global":
        return None
    if text == "file":
        check_poses(log)
        return np.asarray(log.corrected[0])
    return _pose("--start", text, "file, global or ")


def _pose(option: str, text: str, others: str = "") -> Float[np.ndarray, "3"]:
    """The pose (3,) of X,Y,HEADING [m, m, deg]."""
    try:
        pose = np.array([float(field) for field in text.split(",")])
    except ValueError:
        pose = np.zeros(0)
    if pose.shape != (3,) or not np.all(np.isfinite(pose)):
        raise ValueError(f"{option}: expected {others}X,Y,HEADING [m, m, deg], got {text!r}")
    pose[2] = np.angle(np.exp(1j * np.deg2rad(pose[2])))
    return pose
