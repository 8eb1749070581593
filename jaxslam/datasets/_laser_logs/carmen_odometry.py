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
    """the last line before each scan; -1 if none"""
    raw: Float[np.ndarray, "K 3"]
    known: Bool[np.ndarray, "K"]
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
    out = path.copy()
    begins = [*np.flatnonzero(setting), len(path)]
    for i, end in pairwise(begins):
        out[i] = out[i - 1]
        step = poses.between(path[i], path[i + 1 : end])
        out[i + 1 : end] = poses.compose(out[i], step)
    moves = np.cumsum(np.concatenate([[0], ~setting]))[row + 1]
    known = np.diff(moves, prepend=-1) > 0
    return RawOdometry(out, time, row, out[np.maximum(row, 0)], known, int(setting.sum()))


def setting_lines(
    path: Float[np.ndarray, "T 3"],
    time: Float[np.ndarray, "T"],
    row: Int[np.ndarray, "S"],
    robot: Float[np.ndarray, "S 3"],
) -> tuple[Bool[np.ndarray, "T"], str]:
    """Which ODOM lines set the odometry, and a note where that is judged by the motion.

    Programs that correct a log write such lines.

    They repeat the pose of the previous scan, and so differ from the ODOM line before that scan. In
    a raw log a line may repeat it by chance, or since the logger writes the two in this order. So a
    line with a later stamp than the previous one sets the odometry only if at least half of the
    lines after a scan are such, other lines remain, and either another such line goes back in time,
    or the steps to these lines are not a part of the motion: corrections have mean zero.

    Args:
        row: of each scan of any laser, the last ODOM line before it, -1 if none.
        robot: the pose of the robot in the line of the scan, NaN if it has none.
    """
    near = _printed(path, robot)
    line = row + 1
    # The first line gives the start of the odometry.
    scans = np.flatnonzero((line > 0) & (line < len(path)) & np.isfinite(robot).all(axis=1))
    follows, at_scan = np.zeros((2, len(path)), bool)
    follows[line[scans]] = True
    at_scan[line[scans[_equal(path[line[scans]], robot[scans], near)]]] = True
    as_before = np.zeros(len(path), bool)
    as_before[1:] = _equal(path[1:], path[:-1], near)
    found = at_scan & ~as_before
    rest = len(path) - 1 - max(int(row[0]), 0) - int(found.sum())
    common = 2 * found.sum() >= (follows & ~(at_scan & as_before)).sum() and rest > 0
    back = np.diff(time, prepend=time[0]) < 0
    ahead = poses.between(path[:-1], path[1:])[:, 0]
    share = abs(ahead[found[1:]].sum()) / max(abs(ahead.sum()), 1e-9)
    judged = bool(common and found.any() and not (found & back).any())
    setting = found & (back | (common and not (judged and share > _MIN_MOTION)))
    taken = "set the odometry" if share <= _MIN_MOTION else "are motion"
    note = (
        f"{found.sum():,} lines ODOM repeat the pose of the scan before them, with later stamps: "
        f"they {taken}, since the steps to them are {100 * share:.0f} % of the way ahead"
    )
    return np.asarray(setting), note if judged else ""


def _printed(path: Float[np.ndarray, "T 3"], robot: Float[np.ndarray, "K 3"]) -> np.ndarray:
    """(3,) half of the last digit that both kinds of lines have, at most half a millimetre."""

    def digits(values: np.ndarray) -> int:
        for count in range(3, 7):
            if np.allclose(np.round(values, count), values, rtol=0, atol=1e-9, equal_nan=True):
                return count
        return 7

    of = [min(digits(path[:, k]), digits(robot[:, k])) for k in range(3)]
    return 0.5 * 10.0 ** -np.array(of, float) + 1e-9


def _equal(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"], near: np.ndarray
) -> Bool[np.ndarray, "n"]:
    """Whether poses are equal; False for NaN."""
    off = np.abs(a - b)
    off[:, 2] = np.abs(poses.wrapped(off[:, 2]))
    return np.asarray((off <= near).all(axis=1))


def odometry_of_poses(robot: Float[np.ndarray, "K 3"]) -> RawOdometry:
    """The odometry of a log without ODOM lines: the poses of the robot, zero if unknown."""
    finite = np.isfinite(robot).all(axis=1)
    known = finite.copy()
    known[0] = True
    raw = np.where(finite[:, None], robot, 0.0)
    row = np.full(len(robot), -1)
    return RawOdometry(np.zeros((0, 3)), np.zeros(0), row, raw, known, 0)


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
    rows = [file.numbers(line, fields, ("t", "x", "y", "theta")) for line, fields in file]
    if not rows:
        raise file.end_error("expected lines t x y theta, got none")
    table = np.array(rows)
    stamps, scans = table[:, 0], len(time)
    order = np.argsort(stamps, kind="stable")
    after = np.clip(np.searchsorted(stamps[order], time), 1, max(len(rows) - 1, 1))
    pair = order[np.minimum(np.stack([after - 1, after]), len(rows) - 1)]
    row = np.take_along_axis(pair, np.abs(stamps[pair] - time).argmin(axis=0)[None], axis=0)[0]
    joins = np.abs(stamps[row] - time) <= _STAMP_TOLERANCE
    note = f"raw odometry is from {file.path}: {len(rows):,} lines, "
    in_time = np.sum(np.diff(stamps) < 0) <= len(stamps) / 2  # else the file runs backwards
    if joins.all():
        used = len(np.unique(row))
        note += f"{used:,} of them joined to the {scans:,} scans by stamp"
    elif len(rows) == scans and (row[joins] == np.flatnonzero(joins)).all() and in_time:
        row, time = np.arange(scans), stamps
        note += "joined to as many scans in order, which take their stamps"
    else:
        raise ValueError(
            f"{file.path}: stamps from {stamps.min():.6f} s to {stamps.max():.6f} s join "
            f"{int(joins.sum())} of the {scans} scans of {source}, from {time.min():.6f} s to "
            f"{time.max():.6f} s, within {_STAMP_TOLERANCE:g} s; expected all, or a line for each "
            "scan"
        )
    path_of = table[:, 1:]
    everywhere = np.ones(scans, bool)
    return RawOdometry(path_of, stamps, row, path_of[row], everywhere, 0), time, note
