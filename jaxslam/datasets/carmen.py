"""Laser logs of CARMEN: odometry and scans, with corrected poses where the file has them.

Source of the public logs: Radish, the robotics data set repository (Howard & Roy 2003); corrected
by the particle filter of GMapping (Grisetti, Stachniss & Burgard 2007).
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxslam.datasets.formats.lines import TextFile
from jaxslam.types import Beams

POSE = ("x", "y", "theta")
ODOMETRY = (*POSE, "v", "omega", "acceleration", "time", "host", "logger time")
BEFORE, AFTER = 9, 14
"""Fields of ROBOTLASER1 before its ranges, and after its remission values."""


@dataclass(frozen=True, eq=False)
class LaserLog:
    """A laser log: K scans of at most B beams, and T lines of raw odometry."""

    name: str
    source: str
    time: Float[np.ndarray, "K"]
    """[s] of each scan, as logged; may repeat where the file has few digits"""
    beams: Beams
    """with leading K; shorter scans are padded by beams that are not valid"""
    corrected: Float[np.ndarray, "K 3"]
    """the pose that stands in the line of the scan: a reference, not the truth"""
    raw: Float[np.ndarray, "K 3"]
    """raw odometry at each scan: of the last ODOM line before it"""
    row: Int[np.ndarray, "K"]
    """that line, as an index of `odometry`; -1 where there is none before"""
    odometry: Float[np.ndarray, "T 3"]
    odometry_time: Float[np.ndarray, "T"]
    max_range: float
    """[m]: ranges from here on are of beams that met nothing, and are set to it"""
    dropped: Mapping[str, int]
    """what the reader left out, by kind"""
    corrections: tuple[str, ...]
    """what it changed, in words"""


class _Scan(NamedTuple):
    """A line with a scan."""

    ranges: Float[np.ndarray, "n"]
    angles: Float[np.ndarray, "n"]
    corrected: list[float]
    robot: list[float]
    time: float
    row: int
    """of the last line of odometry before it"""


def carmen(path: str | Path, *, max_range: float = 50.0) -> LaserLog:
    """A laser log in the format of CARMEN, packed by gzip or not.

    | line | read as |
    |---|---|
    | `ODOM x y θ v ω a time host t` | raw odometry |
    | `FLASER n r… x y θ x y θ time host t` | a scan of n beams over 180°, and its pose |
    | `ROBOTLASER1 …` | a scan with its own angles, the laser's pose and the robot's |

    n beams of FLASER lie 180°/(n - 1) apart if n is odd (361), else 180°/n (180, 360), from -90°
    on. Scans take the odometry of the last ODOM line before them, by the order of lines, since
    stamps may be rounded; where a file has no ODOM lines, the robot's pose of ROBOTLASER1. A range
    that is NaN or not above 0 is not valid. Such beams and all other lines are counted in
    `dropped`.

    Args:
        path: NAME, or NAME.gz beside it.
        max_range: [m].
    Raises:
        ValueError: with file and line: where a line ends early or has a field that is no number;
            on a file without scans or without beams, and on a max_range that is not above 0.
    """
    if not max_range > 0:
        raise ValueError(f"carmen: expected a max_range above 0, got {max_range}")
    file = TextFile(path)
    odometry: list[list[float]] = []
    scans: list[_Scan] = []
    dropped: Counter[str] = Counter()
    for line, fields in file:
        kind = fields[0]
        if kind == "ODOM":
            file.expect(line, fields[1:], ODOMETRY)
            numbers = file.numbers(line, fields[1:8], ODOMETRY[:7])
            odometry.append([*numbers[:3], *file.numbers(line, fields[9:], ODOMETRY[8:])])
        elif kind == "FLASER":
            scans.append(_flaser(file, line, fields, len(odometry) - 1))
        elif kind == "ROBOTLASER1":
            scans.append(_robot_laser(file, line, fields, len(odometry) - 1))
        else:
            dropped["comments" if kind.startswith("#") else f"lines {kind}"] += 1
    if not scans:
        raise file.end_error("expected a line FLASER or ROBOTLASER1, got none")
    if not any(len(scan.ranges) for scan in scans):
        raise file.end_error(f"expected scans with beams, got {len(scans)} of 0 beams")
    return _log_of(file, odometry, scans, max_range, dropped)


def _log_of(
    file: TextFile,
    odometry: list[list[float]],
    scans: list[_Scan],
    max_range: float,
    dropped: Counter[str],
) -> LaserLog:
    """The log of the lines of a file."""
    beams = max(len(scan.ranges) for scan in scans)
    ranges, angles = np.zeros((2, len(scans), beams))
    there = np.zeros((len(scans), beams), bool)
    for k, scan in enumerate(scans):
        count = len(scan.ranges)
        ranges[k, :count], angles[k, :count], there[k, :count] = scan.ranges, scan.angles, True
    valid = there & (ranges > 0)
    if lost := int((there & ~valid).sum()):
        dropped["beams without a range"] = lost
    ranges = np.where(valid, np.minimum(ranges, max_range), 0.0)
    moved = np.array(odometry).reshape(-1, 4)
    row = np.array([scan.row for scan in scans])
    robot = np.array([scan.robot for scan in scans])
    raw = moved[np.maximum(row, 0), :3] if len(moved) else robot
    time = np.array([scan.time for scan in scans])
    corrections = []
    if len(moved) and (early := int((row < 0).sum())):
        corrections.append(f"scans before the first ODOM line, which take its pose: {early}")
    if not len(moved):
        corrections.append("no ODOM lines: raw odometry is the robot's pose of each scan")
    if backward := int((np.diff(time) < 0).sum()):
        corrections.append(f"scans stamped before their predecessor, kept in order: {backward}")
    if file.lines[-1].strip():
        corrections.append(
            f"the last line, {len(file.lines)}, has no newline: its last number may be cut off"
        )
    return LaserLog(
        name=file.path.name.split(".")[0],
        source=str(file.path),
        time=time,
        beams=Beams(ranges, angles, valid),
        corrected=_wrapped(np.array([scan.corrected for scan in scans])),
        raw=_wrapped(raw),
        row=row,
        odometry=_wrapped(moved[:, :3]),
        odometry_time=moved[:, 3],
        max_range=max_range,
        dropped=dict(dropped),
        corrections=tuple(corrections),
    )


def _flaser(file: TextFile, line: int, fields: list[str], row: int) -> _Scan:
    """The scan of a line FLASER; the two poses in it are the corrected one, twice."""
    count = _count(file, line, fields, 1)
    _expect(file, line, fields, count + 11)
    ranges = _ranges(file, line, fields[2 : 2 + count])
    corrected = file.numbers(line, fields[2 + count : 5 + count], POSE)
    robot = file.numbers(line, fields[5 + count : 8 + count], POSE)
    (time,) = file.numbers(line, fields[-1:], ("logger time",))
    step = np.pi / (count - 1 if count % 2 and count > 1 else max(count, 1))
    angles = -np.pi / 2 + step * np.arange(count)
    return _Scan(ranges, angles, corrected, robot, time, row)


def _robot_laser(file: TextFile, line: int, fields: list[str], row: int) -> _Scan:
    """The scan of a line ROBOTLASER1."""
    count = _count(file, line, fields, BEFORE - 1)
    remissions = _count(file, line, fields, BEFORE + count)
    _expect(file, line, fields, BEFORE + count + 1 + remissions + AFTER)
    first, step = file.numbers(line, [fields[2], fields[4]], ("start angle", "resolution"))
    ranges = _ranges(file, line, fields[BEFORE : BEFORE + count])
    laser = file.numbers(line, fields[-AFTER : -AFTER + 3], POSE)
    robot = file.numbers(line, fields[-AFTER + 3 : -AFTER + 6], POSE)
    (time,) = file.numbers(line, fields[-1:], ("logger time",))
    return _Scan(ranges, first + step * np.arange(count), laser, robot, time, row)


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


def _ranges(file: TextFile, line: int, fields: list[str]) -> Float[np.ndarray, "n"]:
    """Ranges [m], 0 for NaN. Raises ValueError on what is no number."""
    bad = None
    try:
        values = np.array(fields, float)
    except ValueError:
        bad = next(k for k, field in enumerate(fields) if not _is_number(field))
    if "_" in file.lines[line - 1]:  # float() also accepts 1_000
        bad = next((k for k, field in enumerate(fields) if not _is_number(field)), None)
    if bad is not None:
        raise file.error(line, f"range {bad + 1} is no number: {fields[bad]!r}")
    known: np.ndarray = np.nan_to_num(values, nan=0.0, posinf=np.finfo(float).max, neginf=0.0)
    return known


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field


def _wrapped(poses: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The poses with θ in (-π, π]."""
    return np.column_stack([poses[:, :2], np.angle(np.exp(1j * poses[:, 2]))])
