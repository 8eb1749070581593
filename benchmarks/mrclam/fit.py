"""Calibrations by a robot's true path; `MRCLAM_CALIBRATION` is robot 1's. NumPy only."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from benchmarks.gate import Metric, table
from benchmarks.real_data import DATA
from jaxslam.core.logs._streams import interpolate_poses
from jaxslam.datasets import MRCLAM_CALIBRATION, RobotCalibration
from jaxslam.datasets._account import Account
from jaxslam.datasets._landmark_logs.mrclam_robot import read_landmarks, read_robot, read_truth

RATE = 50.0
"""Of the grid on which odometry is compared with the truth [Hz]."""
FIT, NOISE = 2.0, 8.0
"""Windows of the fit of the odometry, and of its noise [s]."""
WINDOWS = 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0
"""Windows over which errors of the heading are shown [s]."""
LOSS = 0.008, 0.012
"""Scales of the robust loss (soft L1): of the logarithm of a range, of a bearing [rad]."""
MISREAD, LEAST = 0.3, 1e-3
"""A measurement further off, relative or in rad, is of another barcode; least depth [m]."""
TOLERANCE = 0.05, 0.01
"""Of the constants in the package against a new fit: relative, and absolute."""


def camera(folder: Path, robot: int, turned: bool) -> tuple[np.ndarray, float, np.ndarray]:
    """(depth, ahead, yaw, axis), the time from a measurement to the truth, and the residuals'
    deviations. Unless turned, yaw and axis are zero. Misread barcodes are left out."""
    subject_of, names, points = read_landmarks(folder, True, Account())
    truth, (_, seen) = read_truth(folder, robot), read_robot(folder, robot)
    index = [names.index(s) if (s := subject_of.get(int(b))) in names else -1 for b in seen[:, 1]]
    which = np.array(index)
    keep = (which >= 0) & (seen[:, 0] > truth[0, 0] + 1) & (seen[:, 0] < truth[-1, 0] - 1)
    begin = truth[0, 0]  # since 1970; differences of the shift would be lost in it
    clock, t = truth[:, 0] - begin, seen[keep, 0] - begin
    z, at = seen[keep, 2:], points[which[keep]]

    def residuals(p):
        depth, ahead, shift, yaw, axis = p
        pose = interpolate_poses(clock, truth[:, 1:], t + shift)
        gap, c, s = at - pose[:, :2], np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x, y = c * gap[:, 0] + s * gap[:, 1] - ahead, c * gap[:, 1] - s * gap[:, 0]
        bearing = np.angle(np.exp(1j * (np.arctan2(y, x) - yaw)))
        along = np.maximum(np.hypot(x, y) * np.cos(bearing - axis), LEAST)
        return np.stack([np.log(z[:, 0] / (depth * along)), z[:, 1] - bearing])

    good = (np.abs(residuals([1.0, 0.0, 0.0, 0.0, 0.0])) < MISREAD).all(axis=0)

    def whole(p):
        return [*p, 0.0, 0.0][:5]

    def scaled(p):
        return (residuals(whole(p))[:, good] / np.array(LOSS)[:, None]).ravel()

    found = whole(least_squares(scaled, np.eye(5 if turned else 3)[0], loss="soft_l1").x)
    deviations = residuals(found)[:, good].std(axis=1)
    return np.array([found[0], found[1], *found[3:]]), float(found[2]), deviations


class Odometry(NamedTuple):
    """What a robot's true path tells of its odometry."""

    constants: np.ndarray
    """(forward, outer, turn, curvature)"""
    delay: float
    """the time from a command to the truth [s]"""
    noise: np.ndarray
    """(forward, straight, share); the deviation per √s"""
    heading: np.ndarray
    """the deviation of the heading's error per √s, over `WINDOWS` [rad/√s]"""


def odometry(folder: Path, robot: int, window: float = NOISE) -> Odometry:
    """Constants and noise of a robot's odometry.

    The noise is the deviation per √s over windows of so many seconds: of travel, of heading where
    the robot goes straight, and of heading per |ω| beyond that where it turns.
    """
    truth, (lines, _) = read_truth(folder, robot), read_robot(folder, robot)
    grid = np.arange(lines[0, 0] + 1, truth[-1, 0] - 1, 1 / RATE)
    path = interpolate_poses(truth[:, 0], truth[:, 1:], grid)
    heading = np.unwrap(path[:, 2])

    def along(window):
        n = int(window * RATE)
        middle = heading[n // 2 :][: len(grid) - n]
        gap = path[n:, :2] - path[:-n, :2]
        return np.cos(middle) * gap[:, 0] + np.sin(middle) * gap[:, 1]

    def told(column, delay, n):
        total = np.concatenate([[0], np.cumsum(column[:-1] * np.diff(lines[:, 0]))])
        way = np.interp(grid - delay, lines[:, 0], total)
        return way[n:] - way[:-n]

    v, omega, n = lines[:, 1], lines[:, 2], int(FIT * RATE)
    best = (np.inf,)
    for delay in np.arange(0.0, 0.5, 0.01):
        turned = told(omega, delay, n)
        change = heading[n:] - heading[:-n]
        turn = turned @ change / (turned @ turned)
        best = min(best, (np.std(change - turn * turned), delay, turn))
    _, delay, _ = best
    columns = np.column_stack([told(omega, delay, n), told(v, delay, n)])
    turn, curvature = np.linalg.lstsq(columns, heading[n:] - heading[:-n], rcond=None)[0]
    columns = np.column_stack([told(v, delay, n), -told(np.abs(omega), delay, n)])
    forward, outer = np.linalg.lstsq(columns, along(FIT), rcond=None)[0]

    one = told(omega, delay, 1) * RATE
    step = path[1:, :2] - path[:-1, :2]
    middle = (heading[1:] + heading[:-1]) / 2
    off_along = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    off_along = off_along - forward * told(v, delay, 1) + outer * told(np.abs(omega), delay, 1)
    off_heading = np.diff(heading) - turn * one / RATE - curvature * told(v, delay, 1)

    def density(error, rows, window=window):
        """Of the errors of these rows alone, per second in which there are any."""
        total = np.concatenate([[0], np.cumsum(np.where(rows, error, 0))])
        n = int(window * RATE)
        gap = total[n:] - total[:-n]
        return np.sqrt((gap**2).mean() / window / rows.mean())

    turning = np.abs(one) > 0.1
    going = (told(v, delay, 1) * RATE > 0.02) & (np.abs(one) < 0.05)
    straight = density(off_heading, going)
    omega_turning = turn * np.sqrt((one[turning] ** 2).mean())
    share = np.sqrt(density(off_heading, turning) ** 2 - straight**2) / omega_turning
    every = np.ones(len(one), bool)
    noise = np.array([density(off_along, every), straight, share])
    heading = np.array([density(off_heading, every, each) for each in WINDOWS])
    return Odometry(np.array([forward, outer, turn, curvature]), float(delay), noise, heading)


def fit(
    folder: Path, robot: int = 1, *, turned: bool = False, window: float = NOISE
) -> RobotCalibration:
    """The calibration by a robot's true path. Unless turned, the camera's yaw and axis are left at
    zero: they differ from robot to robot. window: of the noise of the odometry [s]."""
    (depth, *place), shift, seen = camera(folder, robot, turned)
    found = odometry(folder, robot, window)
    wheels, delay = found.constants, found.delay - shift
    return RobotCalibration(delay, *wheels, depth, *place, *found.noise, *seen)


def measure(quick: bool = False) -> list[Metric]:
    """The fit beside the constants of the package, with a gate for the worst difference."""
    folder, worst = DATA / "mrclam6", 0.0
    if not folder.is_dir():
        print(f"no folder {folder}")
        return []
    rows, fields = [], RobotCalibration._fields
    for name, new, kept in zip(fields, fit(folder), MRCLAM_CALIBRATION, strict=True):
        rows.append([name, f"{new:.4f}", f"{kept:.4f}"])
        relative, absolute = TOLERANCE
        worst = max(worst, abs(new - kept) / max(relative * abs(kept), relative * absolute))
    print(table(["robot 1 of data set 6", "fitted", "package"], rows))
    return [Metric("constants off the fit, share of the tolerance", worst, high=1.0)]
