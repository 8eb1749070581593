"""The scan lines of a log together: stamps, beams, mount of the laser, poses of the robot."""

from collections import Counter

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam.core.types import Beams
from jaxslam.datasets.carmen.lines import Scan, has_poses
from jaxslam.datasets.lines import TextFile
from jaxslam.math import numpy_poses as poses

LOOSE = 0.01, np.deg2rad(0.5)
"""[m], [rad] by which the mount may differ between lines."""

_REAR = np.array([0.0, 0.0, np.pi])


def clock_of(scans: list[Scan], corrections: list[str]) -> int:
    """Which of the two times of a line counts: 0 of the measurement, 1 of the logger, where those
    of the measurements are all the same."""
    taken, logged = np.array([scan.times for scan in scans]).T
    if len(scans) == 1 or np.ptp(taken) > 0:
        return 0
    if np.ptp(logged) > 0:
        corrections.append("all scans have the same timestamp: times are the logger's")
        return 1
    corrections.append("all scans have the same time, by the logger as well")
    return 0


def beams_of(
    scans: list[Scan], max_range: float, dropped: Counter[str], corrections: list[str]
) -> tuple[Beams, float]:
    """The beams (K, B), and the range [m] to which those are set that met nothing."""
    width = max(len(scan.ranges) for scan in scans)
    ranges, angles = np.zeros((2, len(scans), width))
    there = np.zeros((len(scans), width), bool)
    for k, scan in enumerate(scans):
        count = len(scan.ranges)
        ranges[k, :count], angles[k, :count], there[k, :count] = scan.ranges, scan.angles, True
    valid = there & (ranges > 0)
    if lost := int((there & ~valid).sum()):
        dropped["beams without a range"] = lost
    limits = np.minimum([scan.limit for scan in scans], max_range)
    if (code := _code_of_no_return(ranges[valid & (ranges < limits[:, None])])) is not None:
        corrections.append(
            f"ranges from {code:.2f} m on, where the log has many and just below hardly any, are "
            "taken for the laser's sign that a beam met nothing"
        )
        limits = np.minimum(limits, code)
    if unstated := sum(scan.bad_limit for scan in scans):
        corrections.append(
            "scans whose line states no maximum range above 0, which take the one asked for: "
            f"{unstated}"
        )
    limit = float(limits.max())
    if (limits < limit).any():
        corrections.append(
            f"maximum ranges differ, from {limits.min():g} m on: a beam beyond that of its scan "
            f"met nothing and is set to {limit:g} m"
        )
    ranges = np.where(ranges >= limits[:, None], limit, ranges)
    return Beams(np.where(valid, ranges, 0.0), angles, valid), limit


def _code_of_no_return(ranges: Float[np.ndarray, "n"]) -> float | None:
    """The range from which on beams met nothing [m], of a laser that says so by its largest range;
    None where ranges do not show that.

    They do if the last hundredth of the largest range has more than one beam in 500, ten times as
    many as the tenth below it, and two values are 93 % of them: a wall that is seen from one place
    alone is measured with noise, but a code is one number, or in a pair of units two.
    """
    if len(ranges) < 1000:
        return None
    code = 0.99 * float(ranges.max())
    last = ranges[ranges >= code]
    below = int(((ranges < code) & (ranges >= 0.9 * code)).sum())
    if len(last) <= max(len(ranges) / 500, 10 * below):
        return None
    _, count = np.unique(last, return_counts=True)
    return code if np.sort(count)[-2:].sum() > 0.93 * len(last) else None


def checked_mount(mount: ArrayLike) -> Float[np.ndarray, "3"]:
    """A mount that was given; raises ValueError unless it is three finite numbers."""
    try:
        frame = np.asarray(mount, float)
    except (TypeError, ValueError):
        frame = np.zeros(0)
    if frame.shape != (3,) or not np.isfinite(frame).all():
        told = " ".join(str(mount).split())
        raise ValueError(f"carmen: expected a mount of three finite numbers, got {told}")
    return frame


def mount_of(
    file: TextFile, kind: str, scans: list[Scan], corrections: list[str]
) -> Float[np.ndarray, "3"]:
    """The laser's pose on the robot, robot⁻¹ ∘ laser, as constant as it is printed.

    FLASER and RLASER may have a corrected pose in place of the laser's: where the two poses are the
    same, or differ by no constant, the laser looks ahead, that of RLASER back.

    Raises ValueError, with file and line, where it differs between lines of ROBOTLASER.
    """
    default = _REAR.copy() if kind == "RLASER" else np.zeros(3)
    if not has_poses(kind):
        return default
    laser, robot = (np.array([getattr(scan, of) for scan in scans]) for of in ("laser", "robot"))
    mounts = poses.between(robot, laser)
    off = poses.between(mounts[0], mounts)
    far = _beyond(off)
    if not kind.startswith("ROBOTLASER"):
        if far.any():
            corrections.append(
                f"the two poses of {kind} differ by no constant mount: the first is taken for the "
                "robot's corrected pose"
            )
        if far.any() or not _beyond(mounts[:1]).any():
            return default
        corrections.append(f"the mount is that of the two poses of {kind}: {told(mounts[0])}")
    elif far.any():
        k = int(far.argmax())
        raise file.error(
            scans[k].line,
            f"the laser is at {told(mounts[k])} on the robot, in line {scans[0].line} at "
            f"{told(mounts[0])}: expected one mount [m, m, deg], or one that is given",
        )
    # The median of what is left is free of the rounding of a single line.
    return poses.compose(mounts[0], np.median(off, axis=0))


def _beyond(off: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which poses differ from zero by more than printing and rounding do."""
    return (np.hypot(off[:, 0], off[:, 1]) > LOOSE[0]) | (np.abs(off[:, 2]) > LOOSE[1])


def told(pose: Float[np.ndarray, "3"]) -> str:
    """A pose in words, metres and degrees."""
    x, y, heading = pose
    return f"({x:.4g}, {y:.4g}, {np.rad2deg(heading):.4g}°)"


def robot_poses(
    kind: str, scans: list[Scan], mount: Float[np.ndarray, "3"], given: bool
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 3"]]:
    """The robot's corrected poses, and the robot's poses as they stand in the lines.

    given: the mount is not that of the lines.
    """
    laser, robot = (np.array([getattr(scan, of) for scan in scans]) for of in ("laser", "robot"))
    if kind.startswith("ROBOTLASER") and not given:
        return robot, robot
    if kind.startswith("RAWLASER"):
        return np.zeros_like(robot), robot
    # Programs that correct a log write one pose twice, which then is the robot's.
    twice = (laser == robot).all(axis=1, keepdims=True)
    if not mount.any() or twice.all():
        return laser, robot
    return np.where(twice, robot, poses.compose(laser, poses.inverse(mount))), robot
