"""Raw odometry of a log: from ODOM lines, without those that set it, or from a file."""

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.datasets._lines import TextFile
from jaxslam.math import numpy_poses as poses

_STAMP_TOLERANCE = 1e-3
"""Largest difference between the stamps of a line of odometry and its scan [s]."""


_MIN_MOTION = 0.2
"""Share of the way ahead above which the steps to lines that may set the odometry are motion.

Corrections have up to 0.03 in the logs of `docs/guide/real_data.md` with odometry at every scan; a
raw log whose scans are written before the line of their pose has 1/n with n lines per scan."""


class RawOdometry(NamedTuple):
    """T lines of raw odometry, and the odometry at K scans."""

    poses: Float[np.ndarray, "T 3"]
    time: Float[np.ndarray, "T"]
    row: Int[np.ndarray, "K"]
    """index of the last line before each scan; -1 if none"""
    raw: Float[np.ndarray, "K 3"]
    """odometry at each scan"""
    step_known: Bool[np.ndarray, "K"]
    """whether the step from the previous scan is known; True for the first"""
    setting: int
    """number of lines that set the odometry"""


def odometry_of_lines(
    path: Float[np.ndarray, "T 3"],
    time: Float[np.ndarray, "T"],
    setting: Bool[np.ndarray, "T"],
    row: Int[np.ndarray, "K"],
) -> RawOdometry:
    """The odometry at K scans from T >= 1 ODOM lines, some of which set it.

    A line that sets the odometry is not motion: the path continues from its last pose.

    Args:
        row: of each scan, the last ODOM line before it, -1 if none.
    """
    chained = path.copy()
    begins = [*np.flatnonzero(setting), len(path)]
    for i, end in pairwise(begins):
        chained[i] = chained[i - 1]
        step = poses.between(path[i], path[i + 1 : end])
        chained[i + 1 : end] = poses.compose(chained[i], step)
    moves = np.cumsum(np.concatenate([[0], ~setting]))[row + 1]
    step_known = np.diff(moves, prepend=-1) > 0
    raw = chained[np.maximum(row, 0)]
    return RawOdometry(chained, time, row, raw, step_known, int(setting.sum()))


def setting_lines(
    path: Float[np.ndarray, "T 3"],
    time: Float[np.ndarray, "T"],
    row: Int[np.ndarray, "S"],
    robot: Float[np.ndarray, "S 3"],
) -> tuple[Bool[np.ndarray, "T"], str]:
    """The mask of the ODOM lines that set the odometry, and a note if that is judged by the motion.

    Programs that correct a log write such lines. They repeat the pose of the previous scan, and so
    differ from the ODOM line before that scan. In a raw log a line may repeat the pose by chance,
    or since the logger writes the two in this order.

    | line that repeats the scan's pose | sets the odometry |
    |---|---|
    | its stamp goes back | yes |
    | rare: fewer than half of the lines after a scan, or no other lines remain | no |
    | common, and such a line goes back in time | yes |
    | common, and the steps to such lines are part of the motion | no |
    | common, and the steps are not: corrections have mean zero | yes |

    Args:
        row: of each scan of any laser, the last ODOM line before it, -1 if none.
        robot: the pose of the robot in the line of the scan, NaN if it has none.
    """
    near = _print_tolerance(path, robot)
    line = row + 1
    # The first line gives the start of the odometry.
    scans = np.flatnonzero((line > 0) & (line < len(path)) & np.isfinite(robot).all(axis=1))
    follows, at_scan = np.zeros((2, len(path)), bool)
    follows[line[scans]] = True
    at_scan[line[scans[_equal(path[line[scans]], robot[scans], near)]]] = True
    as_before = np.zeros(len(path), bool)
    as_before[1:] = _equal(path[1:], path[:-1], near)
    repeats = at_scan & ~as_before
    others = len(path) - 1 - max(int(row[0]), 0) - int(repeats.sum())
    common = 2 * repeats.sum() >= (follows & ~(at_scan & as_before)).sum() and others > 0
    back = np.diff(time, prepend=time[0]) < 0
    ahead = poses.between(path[:-1], path[1:])[:, 0]
    share = abs(ahead[repeats[1:]].sum()) / max(abs(ahead.sum()), 1e-9)
    by_motion = bool(common and repeats.any() and not (repeats & back).any())
    setting = repeats & (back | (common and not (by_motion and share > _MIN_MOTION)))
    meaning = "set the odometry" if share <= _MIN_MOTION else "are motion"
    note = (
        f"{repeats.sum():,} lines ODOM repeat the pose of the scan before them, with later stamps: "
        f"they {meaning}, since the steps to them are {100 * share:.0f} % of the way ahead"
    )
    return np.asarray(setting), note if by_motion else ""


def _print_tolerance(path: Float[np.ndarray, "T 3"], robot: Float[np.ndarray, "K 3"]) -> np.ndarray:
    """Half of the last printed digit (3,) that both kinds of lines have, at most 0.5 mm."""

    def digits(values: np.ndarray) -> int:
        for count in range(3, 7):
            if np.allclose(np.round(values, count), values, rtol=0, atol=1e-9, equal_nan=True):
                return count
        return 7

    common = [min(digits(path[:, k]), digits(robot[:, k])) for k in range(3)]
    return 0.5 * 10.0 ** -np.array(common, float) + 1e-9


def _equal(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"], near: np.ndarray
) -> Bool[np.ndarray, "n"]:
    """The mask of equal poses; False for NaN."""
    off = np.abs(a - b)
    off[:, 2] = np.abs(poses.wrapped(off[:, 2]))
    return np.asarray((off <= near).all(axis=1))


def odometry_of_poses(robot: Float[np.ndarray, "K 3"]) -> RawOdometry:
    """The odometry of a log without ODOM lines: the poses of the robot, zero if unknown."""
    finite = np.isfinite(robot).all(axis=1)
    step_known = finite.copy()
    step_known[0] = True
    raw = np.where(finite[:, None], robot, 0.0)
    row = np.full(len(robot), -1)
    return RawOdometry(np.zeros((0, 3)), np.zeros(0), row, raw, step_known, 0)


def odometry_of_file(
    path: str | Path, time: Float[np.ndarray, "K"], source: str
) -> tuple[RawOdometry, Float[np.ndarray, "K"], str]:
    """The odometry at each scan from a file of lines `t x y θ`, the times of the scans, and a note.

    Each scan takes the line with the nearest stamp, within `_STAMP_TOLERANCE`. As many lines as
    scans, whose stamps do not contradict their order, join in order and give the scans their
    stamps.

    Raises ValueError, with file and line, on malformed lines, and on stamps that do not join.
    """
    file = TextFile(path, comment="#")
    _, table = file.table(("t", "x", "y", "theta"))
    stamps, scans = table[:, 0], len(time)
    order = np.argsort(stamps, kind="stable")
    after = np.clip(np.searchsorted(stamps[order], time), 1, max(len(table) - 1, 1))
    pair = order[np.minimum(np.stack([after - 1, after]), len(table) - 1)]
    row = np.take_along_axis(pair, np.abs(stamps[pair] - time).argmin(axis=0)[None], axis=0)[0]
    joins = np.abs(stamps[row] - time) <= _STAMP_TOLERANCE
    note = f"raw odometry is from {file.path}: {len(table):,} lines, "
    in_time = np.sum(np.diff(stamps) < 0) <= len(stamps) / 2  # else the file runs backwards
    if joins.all():
        used = len(np.unique(row))
        note += f"{used:,} of them joined to the {scans:,} scans by stamp"
    elif len(table) == scans and (row[joins] == np.flatnonzero(joins)).all() and in_time:
        row, time = np.arange(scans), stamps
        note += "joined to as many scans in order, which take their stamps"
    else:
        raise ValueError(
            f"{file.path}: stamps from {stamps.min():.6f} s to {stamps.max():.6f} s join "
            f"{int(joins.sum())} of the {scans} scans of {source}, from {time.min():.6f} s to "
            f"{time.max():.6f} s, within {_STAMP_TOLERANCE:g} s; expected all, or a line for each "
            "scan"
        )
    logged = table[:, 1:]
    step_known = np.ones(scans, bool)
    return RawOdometry(logged, stamps, row, logged[row], step_known, 0), time, note
