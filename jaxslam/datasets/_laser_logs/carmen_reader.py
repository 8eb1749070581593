"""Laser logs of CARMEN: odometry and scans, and corrected poses if the file has them; and relative
poses that score laser SLAM.

Source of the public logs: Radish, the robotics data set repository (Howard & Roy 2003); corrected
by the particle filter of GMapping (Grisetti, Stachniss & Burgard 2007).
"""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.core.validation import InvalidField, finite, or_none, refusals_of, require
from jaxslam.datasets._account import Account
from jaxslam.datasets._laser_logs.carmen_odometry import (
    RawOdometry,
    odometry_of_file,
    odometry_of_lines,
    odometry_of_poses,
    setting_lines,
)
from jaxslam.datasets._laser_logs.carmen_scans import (
    POSE,
    Scan,
    clock_of,
    has_poses,
    is_scan,
    mount_of,
    robot_poses,
    scan_of,
)
from jaxslam.datasets._laser_logs.laser_beams import beams_of
from jaxslam.datasets._laser_logs.laser_record import LaserLog, wrapped_path
from jaxslam.datasets._lines import TextFile
from jaxslam.math import numpy_poses as poses
from jaxslam.math.numpy_poses import wrapped

ODOMETRY = (*POSE, "v", "omega", "acceleration", "time", "host", "logger time")
_PREFERRED = ("FLASER", "ROBOTLASER1", "RAWLASER1", "RLASER")
"""Kinds of scans, the preferred ones first if several are equally frequent."""


def carmen(
    path: str | Path,
    *,
    max_range: float = 50.0,
    laser: str | None = None,
    odometry: str | Path | None = None,
    mount: ArrayLike | None = None,
) -> LaserLog:
    """A laser log in the format of CARMEN, packed by gzip or not.

    | line | read as |
    |---|---|
    | `ODOM x y θ v ω a t host T` | raw odometry, or a line that sets it |
    | `FLASER n r… x y θ x y θ t host T` | a scan of n beams, poses of laser and robot |
    | `RLASER` | the same, of a laser that looks back |
    | `ROBOTLASER1 …`, and other numbers | a scan with angles, a maximum range, both poses |
    | `RAWLASER1 …` | the same, without poses |

    One laser is read. Scans of others, beams whose range is NaN or not above 0, and all other lines
    are counted in `dropped`. Times are those of the measurements (t), or of the logger (T) if all
    scans have the same t.

    **Raw odometry** at a scan is that of the last ODOM line before it, by the order of lines, since
    stamps may be rounded. An ODOM line that repeats the pose of the scan before it, and differs
    from the one before that scan, was written by a program that corrects logs. It sets the
    odometry and is not motion: raw odometry is the chain of the increments between such lines, and
    `corrections` has its largest distance from the poses of the scans. Without ODOM lines, raw
    odometry is the pose of the robot of each scan.

    **Angles** of FLASER: as in CARMEN, from -90°, 1° apart for 180 beams, ½° for 360, else
    180°/(n - 1); for 400 and 401 beams ¼° apart from -50°, the field of 100° of the laser (CARMEN
    begins at -90°).

    **Mount**: the pose of the laser on the robot, from the two poses of a line. If those of FLASER
    or RLASER are equal, or do not differ by a constant, it is zero, or (0, 0, π) for RLASER; it is
    zero for RAWLASER. The corrected pose of the robot in these cases, or with a given mount, is
    that of the laser without the mount, or the pose itself if the line has it twice.

    Args:
        path: NAME, or NAME.gz beside it.
        max_range: ranges from this one [m], or from the maximum in their line, are without a
            return; `LaserLog.max_range` is the largest limit of a scan.
        laser: kind of the lines to read; default: the one with poses and most scans.
        odometry: a file of lines `t x y θ` in place of the log's odometry (`#` begins a comment).
            They join the scans by stamp, to a millisecond; else as many lines as scans join in
            order, and give the scans their stamps.
        mount: (3,) [m, m, rad] in place of that of the lines.
    Raises:
        ValueError: with file and line: on a line that ends early, a field that is not a number, a
            file without scans (of the laser) or without beams, a mount that differs between two
            lines by more than 1 cm or ½°, and odometry that does not join. Also on a max_range
            that is not above 0, and a mount that is not three finite numbers.
    """
    with refusals_of("carmen"):
        if not max_range > 0:
            raise InvalidField("max_range", f"expected a number above 0, got {max_range}")
        given_mount = require("mount", mount, or_none(finite(3)))
    file = TextFile(path)
    lines = list(file)
    kind = _kind(file, Counter(fields[0] for _, fields in lines if is_scan(fields[0])), laser)
    logged: list[list[float]] = []
    scans: list[Scan] = []
    scan_poses: list[tuple[float, ...]] = []
    account = Account()
    for line, fields in lines:
        if is_scan(fields[0]):
            scan = scan_of(file, line, fields, len(logged) - 1)
            scan_poses.append((scan.row, *scan.robot))
            if fields[0] == kind:
                scans.append(scan)
            else:
                account.drop(f"scans {fields[0]}")
        elif fields[0] == "ODOM":
            file.expect(line, fields[1:], ODOMETRY)
            numbers = file.numbers(line, [*fields[1:8], fields[9]], [*ODOMETRY[:7], ODOMETRY[8]])
            logged.append([*numbers[:3], *numbers[6:]])
        else:
            account.drop("comments" if fields[0].startswith("#") else f"lines {fields[0]}")
    if not any(len(scan.ranges) for scan in scans):
        raise file.end_error(f"expected scans with beams, got {len(scans)} of 0 beams")
    clock = clock_of(scans, account)
    time = np.array([scan.times[clock] for scan in scans])
    frame = mount_of(file, kind, scans, account) if given_mount is None else given_mount
    corrected, robot = robot_poses(kind, scans, frame, given_mount is not None)
    if odometry is not None:
        joined, time, note = odometry_of_file(odometry, time, str(file.path))
        account.correct(note)
        account.drop("lines ODOM", len(logged))
    elif logged:
        table, all_scans = np.array(logged), np.array(scan_poses)
        path_logged, stamp = table[:, :3], table[:, 3 + clock]
        setting, note = setting_lines(
            path_logged, stamp, all_scans[:, 0].astype(int), all_scans[:, 1:]
        )
        account.correct(note, note)
        rows = np.array([scan.row for scan in scans])
        joined = odometry_of_lines(path_logged, stamp, setting, rows)
    else:
        joined = odometry_of_poses(robot)
    beams, limit = beams_of(scans, max_range, account)
    _note_irregularities(kind, time, joined, corrected, account)
    account.correct(
        f"the last line, {len(file.lines)}, has no newline: its last number may be cut off",
        file.lines[-1].strip(),
    )
    return LaserLog(
        name=file.path.name.split(".")[0],
        source=str(file.path),
        laser=kind,
        placed=has_poses(kind),
        time=time,
        beams=beams,
        corrected=wrapped_path(corrected),
        raw=wrapped_path(joined.raw),
        odometry_known=joined.step_known,
        row=joined.row,
        odometry=wrapped_path(joined.poses),
        odometry_time=joined.time,
        max_range=limit,
        mount=frame,
        **account.fields,
    )


def _kind(file: TextFile, counts: Counter[str], laser: str | None) -> str:
    """The kind of lines to read: `laser`, or the kind with poses and most scans."""
    if not counts:
        raise file.end_error(
            "expected a line FLASER, RLASER, ROBOTLASER1 or RAWLASER1, and so on, got none"
        )
    if laser is None:
        preference = {kind: rank for rank, kind in enumerate(_PREFERRED)}
        ranking = [
            (not has_poses(kind), -count, preference.get(kind, len(preference)), kind)
            for kind, count in counts.items()
        ]
        return min(ranking)[-1]
    if laser not in counts:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()))
        raise file.end_error(f"expected scans of the laser {laser}, got {kinds}")
    return laser


def _note_irregularities(
    kind: str,
    time: Float[np.ndarray, "K"],
    odometry: RawOdometry,
    corrected: Float[np.ndarray, "K 3"],
    account: Account,
) -> None:
    """Describe the irregularities of a log."""
    logged = len(odometry.poses)
    early = int((odometry.row < 0).sum()) if logged else 0
    account.correct(f"scans before the first ODOM line, which take its pose: {early}", early)
    if not has_poses(kind):
        account.correct(f"lines {kind} have no poses to compare with")
    if not logged:
        account.correct(
            "no ODOM lines: raw odometry is the robot's pose of each scan"
            if has_poses(kind)
            else "no ODOM lines and no poses: raw odometry is unknown, and zero"
        )
    elif has_poses(kind) and odometry.setting:
        apart = poses.between(odometry.raw[0], odometry.raw)[:, :2]
        apart = np.hypot(*(apart - poses.between(corrected[0], corrected)[:, :2]).T)
        account.correct(
            f"ODOM lines that set the odometry to the pose of the scan before: {odometry.setting}; "
            "raw odometry is the chain of the increments between them, and differs from the scans' "
            f"poses by up to {apart.max():.2f} m, {apart[-1]:.2f} m at the end"
        )
    still = int((~odometry.step_known).sum()) if logged else 0
    account.correct(
        f"scans without an ODOM line since the previous scan, with a zero step: {still}", still
    )
    backward = int((np.diff(time) < 0).sum())
    account.correct(f"scans stamped before their predecessor, kept in order: {backward}", backward)


_FIELDS = "t1", "t2", "x", "y", "z", "roll", "pitch", "yaw"
_FLAT = 1e-6
"""Largest z [m], roll and pitch [rad] of a pose in the plane."""


class StampedRelations(NamedTuple):
    """R relative poses between stamps."""

    first: Float[np.ndarray, "R"]
    """[s]"""
    second: Float[np.ndarray, "R"]
    """[s]; may be before `first`"""
    pose: Float[np.ndarray, "R 3"]
    """(x, y, θ) at `second` in the frame of the pose at `first` [m, m, rad]"""
    source: str
    """the file"""


def relation_file(path: str | Path) -> StampedRelations:
    """The relations of a file of the Freiburg benchmark, packed by gzip or not.

    A line: `t1 t2 x y z roll pitch yaw` [s, m, rad], the pose at t2 in the frame of that at t1.
    Blank lines and lines that begin with # are skipped. `metrics.relations_at_stamps` joins the
    relations to a path.

    Source: Kümmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss & Kleiner 2009, "On measuring
    the accuracy of SLAM algorithms", Autonomous Robots 27.

    Raises ValueError, `path:line: reason`, on a malformed line, a pose that is not in the plane
    (z, roll or pitch above 1e-6), and a file without relations.
    """
    file = TextFile(path, comment="#")
    lines, table = file.table(_FIELDS)
    if (off := np.argwhere(np.abs(table[:, 4:7]) > _FLAT)).size:
        row, column = off[0]
        reason = f"with {_FIELDS[4 + column]} 0, got {table[row, 4 + column]}"
        raise file.error(lines[row], f"expected a pose in the plane, {reason}")
    pose = np.stack([table[:, 2], table[:, 3], wrapped(table[:, 7])], axis=1)
    return StampedRelations(table[:, 0], table[:, 1], pose, str(file.path))
