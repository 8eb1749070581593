"""Raw odometry of a log: lines ODOM chained over those that set the odometry, or of a file."""

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.datasets.lines import TextFile
from jaxslam.math import numpy_poses as poses

_JOINED = 1e-3
"""[s] within which a stamp of a file of odometry is that of a scan."""


_MOTION = 0.2
"""The share of the way ahead from which on the steps to lines that may set the odometry are motion.
In the logs of `docs/guide/real_data.md` with odometry at every scan corrections have up to 0.03; in
a raw log whose scans are written before the line of their pose it is 1/n with n lines a scan."""


class RawOdometry(NamedTuple):
    """T lines of raw odometry, and what they say at K scans."""

    poses: Float[np.ndarray, "T 3"]
    time: Float[np.ndarray, "T"]
    row: Int[np.ndarray, "K"]
    """the last line before each scan; -1 where there is none"""
    raw: Float[np.ndarray, "K 3"]
    known: Bool[np.ndarray, "K"]
    """whether a line tells of the step from the scan before; True for the first"""
    setting: int
    """lines that set the odometry"""


def chained(
    path: Float[np.ndarray, "T 3"],
    time: Float[np.ndarray, "T"],
    setting: Bool[np.ndarray, "T"],
    row: Int[np.ndarray, "K"],
) -> RawOdometry:
    """The odometry of T >= 1 lines ODOM, of which some set it, at K scans.

    No motion lies between a line that sets the odometry and the line before it: there the path goes
    on from where it was.

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
) -> Bool[np.ndarray, "T"]:
    """Which ODOM lines set the odometry, as a program that corrects a log writes them.

    Such a line repeats the pose of the scan before, and so differs from the ODOM line before that
    scan. A line of a raw log may repeat it by chance, or since the logger wrote the two in this
    order. So a line stamped after the one before it counts only where at least half of the lines
    that follow a scan are such, other lines remain, and either another such line goes back in time,
    or the steps to these lines are no share of the motion: corrections lead nowhere on average.

    Args:
        row: of each scan of any laser, the last ODOM line before it, -1 if none.
        robot: the pose of the robot in the line of the scan, NaN where there is none.
    """
    near = _printed(path, robot)
    line = row + 1
    # The first line tells where odometry begins.
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
    motion = abs(ahead[found[1:]].sum()) > _MOTION * abs(ahead.sum())
    setting = found & (back | (common and ((found & back).any() or not motion)))
    return np.asarray(setting)


def _printed(path: Float[np.ndarray, "T 3"], robot: Float[np.ndarray, "K 3"]) -> np.ndarray:
    """(3,) half of the last digit that both kinds of lines print, at most half a millimetre."""

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
    """Whether poses are the same; False where one is NaN."""
    off = np.abs(a - b)
    off[:, 2] = np.abs(poses.wrapped(off[:, 2]))
    return np.asarray((off <= near).all(axis=1))


def without_lines(robot: Float[np.ndarray, "K 3"]) -> RawOdometry:
    """The odometry of a log without ODOM lines: the robot's poses, zero where there are none."""
    there = np.isfinite(robot).all(axis=1)
    known = there.copy()
    known[0] = True
    raw = np.where(there[:, None], robot, 0.0)
    row = np.full(len(robot), -1)
    return RawOdometry(np.zeros((0, 3)), np.zeros(0), row, raw, known, 0)


def of_file(
    path: str | Path, time: Float[np.ndarray, "K"], source: str
) -> tuple[RawOdometry, Float[np.ndarray, "K"], str]:
    """The odometry of a file, lines `t x y θ`, at each scan, the scans' times, and how they join.

    Each scan takes the line whose stamp is nearest, within `_JOINED`. Where there are as many lines
    as scans and no stamp contradicts that, they join in order, and the lines' stamps are the times.

    Raises ValueError, with file and line, on lines that are none; on stamps that do not join.
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
    joins = np.abs(stamps[row] - time) <= _JOINED
    told = f"raw odometry is of {file.path}: {len(rows):,} lines, "
    in_time = np.sum(np.diff(stamps) < 0) <= len(stamps) / 2  # else the file runs backwards
    if joins.all():
        used = len(np.unique(row))
        told += f"{used:,} of them joined to the {scans:,} scans by stamp"
    elif len(rows) == scans and (row[joins] == np.flatnonzero(joins)).all() and in_time:
        row, time = np.arange(scans), stamps
        told += "joined to as many scans in order, which take their stamps"
    else:
        raise ValueError(
            f"{file.path}: stamps from {stamps.min():.6f} s to {stamps.max():.6f} s join "
            f"{int(joins.sum())} of the {scans} scans of {source}, from {time.min():.6f} s to "
            f"{time.max():.6f} s, within {_JOINED:g} s; expected all, or a line for each scan"
        )
    path_of = table[:, 1:]
    everywhere = np.ones(scans, bool)
    return RawOdometry(path_of, stamps, row, path_of[row], everywhere, 0), time, told
