"""The lines of CARMEN that hold a scan."""

import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.datasets.lines import TextFile

POSE = ("x", "y", "theta")
_TIMES = ("timestamp", "logger time")
_BEFORE = 9
"""Fields of ROBOTLASER and RAWLASER before the ranges."""


class Scan(NamedTuple):
    """A line with a scan."""

    line: int
    ranges: Float[np.ndarray, "n"]
    """[m] 0 where the file has NaN"""
    angles: Float[np.ndarray, "n"]
    laser: list[float]
    """the laser's pose, NaN where the line has none"""
    robot: list[float]
    """the robot's"""
    times: list[float]
    """[s] of the scan, of the logger"""
    limit: float
    """[m] the maximum range that the line states, infinite if it states none"""
    bad_limit: bool
    """it states one that is not finite and above 0"""
    row: int
    """of the last line ODOM before it, -1 if none"""


def has_poses(kind: str) -> bool:
    """Whether lines of a kind state where laser and robot are."""
    return not kind.startswith("RAWLASER")


def is_scan(kind: str) -> bool:
    """Whether lines of a kind hold a scan: FLASER, RLASER, ROBOTLASER1 …, RAWLASER1 …."""
    return re.fullmatch("[FR]LASER|(ROBOT|RAW)LASER[0-9]+", kind) is not None


def scan_of(file: TextFile, line: int, fields: list[str], row: int) -> Scan:
    """The scan of a line; raises ValueError, with file and line, on what is none."""
    read = _flaser if fields[0] in ("FLASER", "RLASER") else _configured_laser
    return read(file, line, fields, row)


def _flaser(file: TextFile, line: int, fields: list[str], row: int) -> Scan:
    """Of FLASER and RLASER: `n r… x y θ x y θ time host t`."""
    count = _count(file, line, fields, 1)
    _expect(file, line, fields, count + 11)
    ranges = _ranges(file, line, fields[2 : 2 + count])
    laser = file.numbers(line, fields[2 + count : 5 + count], POSE)
    robot = file.numbers(line, fields[5 + count : 8 + count], POSE)
    times = file.numbers(line, [fields[-3], fields[-1]], _TIMES)
    return Scan(line, ranges, _angles_of(count), laser, robot, times, np.inf, False, row)


def _angles_of(count: int) -> Float[np.ndarray, "n"]:
    """The angles of n beams of FLASER [rad], which has none: those of a SICK LMS, as in CARMEN.

    1° apart for 180, ½° for 360, from -90° on: there the last beam is left out. ¼° apart for 400
    and 401, from -50° on, the laser's field of 100° looking ahead. Else over 180°, from -90° on.
    """
    if count in (400, 401):
        return np.asarray(np.deg2rad(-50.0 + 0.25 * np.arange(count)))
    step = np.pi / (count if count in (180, 360) else max(count - 1, 1))
    return -np.pi / 2 + step * np.arange(count)


def _configured_laser(file: TextFile, line: int, fields: list[str], row: int) -> Scan:
    """Of ROBOTLASER and RAWLASER: `type start field-of-view resolution maximum-range accuracy
    remission-mode n r… m remission… time host t`, before the time of ROBOTLASER two poses and five
    more fields."""
    after = 14 if has_poses(fields[0]) else 3
    count = _count(file, line, fields, _BEFORE - 1)
    remissions = _count(file, line, fields, _BEFORE + count)
    _expect(file, line, fields, _BEFORE + count + 1 + remissions + after)
    first, step = file.numbers(line, [fields[2], fields[4]], ("start angle", "resolution"))
    ranges = _ranges(file, line, fields[_BEFORE : _BEFORE + count])
    stated = _ranges(file, line, [fields[5]], "the maximum range")[0]
    good = 0 < stated < np.finfo(float).max
    limit = float(stated) if good else np.inf
    laser = robot = [np.nan] * 3
    if has_poses(fields[0]):
        laser = file.numbers(line, fields[-after : 3 - after], POSE)
        robot = file.numbers(line, fields[3 - after : 6 - after], POSE)
    times = file.numbers(line, [fields[-3], fields[-1]], _TIMES)
    angles = first + step * np.arange(count)
    return Scan(line, ranges, angles, laser, robot, times, limit, not good, row)


def _count(file: TextFile, line: int, fields: list[str], at: int) -> int:
    """The number of values that a field announces."""
    if len(fields) <= at:
        raise file.error(line, f"{fields[0]} ends after {len(fields)} fields")
    return file.identity(line, fields[at], "the number of values")


def _expect(file: TextFile, line: int, fields: list[str], count: int) -> None:
    if len(fields) != count:
        raise file.error(
            line, f"expected {count} fields in this line {fields[0]}, got {len(fields)}"
        )


def _ranges(
    file: TextFile, line: int, fields: list[str], name: str = "range"
) -> Float[np.ndarray, "n"]:
    """Ranges [m], 0 for NaN. Raises ValueError on what is no number."""
    bad = None
    try:
        values = np.array(fields, float)
    except ValueError:
        bad = next(k for k, field in enumerate(fields) if not _is_number(field))
    if "_" in file.lines[line - 1]:  # float() also accepts 1_000
        bad = next((k for k, field in enumerate(fields) if not _is_number(field)), None)
    if bad is not None:
        which = f"{name} {bad + 1}" if name == "range" else name
        raise file.error(line, f"{which} is no number: {fields[bad]!r}")
    known: np.ndarray = np.nan_to_num(values, nan=0.0, posinf=np.finfo(float).max, neginf=0.0)
    return known


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field
