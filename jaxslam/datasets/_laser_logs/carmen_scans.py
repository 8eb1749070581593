"""Scans of a CARMEN log: parsing of lines; stamps, mount and poses of all scans."""

import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.datasets._account import Account
from jaxslam.datasets._laser_logs.laser_record import differs_from_zero, pose_text
from jaxslam.datasets._lines import TextFile
from jaxslam.math import numpy_poses as poses

POSE = ("x", "y", "theta")
_TIMES = ("timestamp", "logger time")
_BEFORE = 9
"""Fields of ROBOTLASER and RAWLASER before the ranges."""


class Scan(NamedTuple):
    """A line with a scan."""

    line: int
    ranges: Float[np.ndarray, "n"]
    """[m], 0 for NaN in the file"""
    angles: Float[np.ndarray, "n"]
    laser: list[float]
    """pose of the laser, NaN if the line has none"""
    robot: list[float]
    """pose of the robot, NaN if the line has none"""
    times: list[float]
    """times of the measurement and of the logger [s]"""
    limit: float
    """maximum range in the line [m], infinite if it has none"""
    bad_limit: bool
    """whether the line has a maximum range that is not finite and above 0"""
    row: int
    """index of the last ODOM line before it, -1 if none"""


def has_poses(kind: str) -> bool:
    """Whether lines of a kind have the poses of laser and robot."""
    return not kind.startswith("RAWLASER")


def is_scan(kind: str) -> bool:
    """Whether a kind of line is a scan: FLASER, RLASER, ROBOTLASER1 …, RAWLASER1 …."""
    return re.fullmatch("[FR]LASER|(ROBOT|RAW)LASER[0-9]+", kind) is not None


def scan_of(file: TextFile, line: int, fields: list[str], row: int) -> Scan:
    """The scan of a line; ValueError, with file and line, if it is malformed."""
    read = _flaser if fields[0] in ("FLASER", "RLASER") else _configured_laser
    return read(file, line, fields, row)


def _flaser(file: TextFile, line: int, fields: list[str], row: int) -> Scan:
    """A line FLASER or RLASER: `n r… x y θ x y θ time host t`."""
    count = _count(file, line, fields, 1)
    _expect(file, line, fields, count + 11)
    ranges = _ranges(file, line, fields[2 : 2 + count])
    laser = file.numbers(line, fields[2 + count : 5 + count], POSE)
    robot = file.numbers(line, fields[5 + count : 8 + count], POSE)
    times = file.numbers(line, [fields[-3], fields[-1]], _TIMES)
    return Scan(line, ranges, _angles_of(count), laser, robot, times, np.inf, False, row)


def _angles_of(count: int) -> Float[np.ndarray, "n"]:
    """The angles of the n beams of a FLASER line [rad], of a SICK LMS, as in CARMEN.

    From -90°, 1° apart for 180 beams and ½° for 360, without the last beam; from -50°, ¼° apart
    for 400 and 401, the field of 100° of the laser; else over 180°, from -90°.
    """
    if count in (400, 401):
        return np.asarray(np.deg2rad(-50.0 + 0.25 * np.arange(count)))
    step = np.pi / (count if count in (180, 360) else max(count - 1, 1))
    return -np.pi / 2 + step * np.arange(count)


def _configured_laser(file: TextFile, line: int, fields: list[str], row: int) -> Scan:
    """A line ROBOTLASER or RAWLASER: `type start field-of-view resolution maximum-range accuracy
    remission-mode n r… m remission… time host t`, with two poses and five more fields before the
    time of ROBOTLASER."""
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
    """Ranges [m], 0 for NaN; ValueError on a field that is not a number."""
    bad = None
    try:
        values = np.array(fields, float)
    except ValueError:
        bad = next(k for k, field in enumerate(fields) if not _is_number(field))
    if "_" in file.lines[line - 1]:  # float() also accepts 1_000
        bad = next((k for k, field in enumerate(fields) if not _is_number(field)), None)
    if bad is not None:
        which = f"{name} {bad + 1}" if name == "range" else name
        raise file.error(line, f"{which} is not a number: {fields[bad]!r}")
    # ∞ is a range without a return, as the largest number is.
    finite: np.ndarray = np.nan_to_num(values, nan=0.0, posinf=np.finfo(float).max, neginf=0.0)
    return finite


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field


_REAR = np.array([0.0, 0.0, np.pi])
"""Mount of a laser that looks back."""


def clock_of(scans: list[Scan], account: Account) -> int:
    """The index in `Scan.times` of the clock to use.

    0 for the measurement; 1 for the logger, if all measurements have the same time.
    """
    measured, logged = np.array([scan.times for scan in scans]).T
    if len(scans) == 1 or np.ptp(measured) > 0:
        return 0
    if np.ptp(logged) > 0:
        account.correct("all scans have the same timestamp: times are the logger's")
        return 1
    account.correct("all scans have the same time, by the logger as well")
    return 0


def mount_of(
    file: TextFile, kind: str, scans: list[Scan], account: Account
) -> Float[np.ndarray, "3"]:
    """The pose of the laser on the robot, robot⁻¹ ∘ laser.

    FLASER and RLASER may have a corrected pose in place of the laser's: if the two poses are equal,
    or do not differ by a constant, the laser looks ahead, that of RLASER back.

    Raises ValueError, with file and line, if it differs between lines of ROBOTLASER.
    """
    default = _REAR.copy() if kind == "RLASER" else np.zeros(3)
    if not has_poses(kind):
        return default
    laser, robot = (np.array([getattr(scan, of) for scan in scans]) for of in ("laser", "robot"))
    mounts = poses.between(robot, laser)
    off = poses.between(mounts[0], mounts)
    far = differs_from_zero(off)
    if not kind.startswith("ROBOTLASER"):
        if far.any():
            account.correct(
                f"the two poses of {kind} do not differ by a constant mount: the first is taken "
                "for the corrected pose of the robot"
            )
        if far.any() or not differs_from_zero(mounts[:1]).any():
            return default
        account.correct(f"the mount is that of the two poses of {kind}: {pose_text(mounts[0])}")
    elif far.any():
        k = int(far.argmax())
        raise file.error(
            scans[k].line,
            f"the laser is at {pose_text(mounts[k])} on the robot, in line {scans[0].line} at "
            f"{pose_text(mounts[0])}: expected one mount [m, m, deg], or one that is given",
        )
    # The median is free of the rounding of a single line.
    return poses.compose(mounts[0], np.median(off, axis=0))


def robot_poses(
    kind: str, scans: list[Scan], mount: Float[np.ndarray, "3"], is_given: bool
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 3"]]:
    """The corrected poses of the robot, and its poses in the lines.

    is_given: whether the mount is an argument of the reader, not from the lines.
    """
    laser, robot = (np.array([getattr(scan, of) for scan in scans]) for of in ("laser", "robot"))
    if kind.startswith("ROBOTLASER") and not is_given:
        return robot, robot
    if kind.startswith("RAWLASER"):
        return np.zeros_like(robot), robot
    # Programs that correct a log write the pose of the robot twice.
    twice = (laser == robot).all(axis=1, keepdims=True)
    if not mount.any() or twice.all():
        return laser, robot
    return np.where(twice, robot, poses.compose(laser, poses.inverse(mount))), robot
