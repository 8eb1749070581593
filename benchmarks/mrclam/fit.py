"""The calibration of `datasets.mrclam`, fitted on the true path of robot 1 alone; NumPy only."""

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from benchmarks.gate import Metric
from jaxslam.datasets import MRCLAM_CALIBRATION, RobotCalibration
from jaxslam.datasets.mrclam.files import read_landmarks, read_robot, read_truth
from jaxslam.logs.streams import interpolate_poses

RATE = 50.0
"""Of the grid on which odometry is compared with the truth [Hz]."""
FIT, NOISE = 2.0, 8.0
"""Windows of the fit of the odometry, and of its noise [s]."""
LOSS = 0.008, 0.012
"""Scales of the robust loss (soft L1): of the logarithm of a range, of a bearing [rad]."""
TOLERANCE = 0.05, 0.01
"""Of the constants in the package against a new fit: relative, and absolute."""


def camera(folder: Path) -> tuple[np.ndarray, float, np.ndarray]:
    """(depth, ahead), the time from a measurement to the truth, and the residuals' deviations."""
    subject_of, names, points, _ = read_landmarks(folder, errata=True)
    truth, (_, seen) = read_truth(folder, 1), read_robot(folder, 1)
    index = [names.index(s) if (s := subject_of.get(int(b))) in names else -1 for b in seen[:, 1]]
    which = np.array(index)
    keep = (which >= 0) & (seen[:, 0] < truth[-1, 0] - 1)
    begin = truth[0, 0]  # since 1970; differences of the shift would be lost in it
    clock, t = truth[:, 0] - begin, seen[keep, 0] - begin
    z, at = seen[keep, 2:], points[which[keep]]

    def residuals(p):
        depth, ahead, shift = p
        pose = interpolate_poses(clock, truth[:, 1:], t + shift)
        gap, c, s = at - pose[:, :2], np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x, y = c * gap[:, 0] + s * gap[:, 1] - ahead, c * gap[:, 1] - s * gap[:, 0]
        return np.stack([np.log(z[:, 0] / (depth * x)), z[:, 1] - np.arctan2(y, x)])

    def scaled(p):
        return (residuals(p) / np.array(LOSS)[:, None]).ravel()

    found = least_squares(scaled, [1.0, 0.0, 0.0], loss="soft_l1").x
    return found[:2], float(found[2]), residuals(found).std(axis=1)


def odometry(folder: Path) -> tuple[np.ndarray, float, np.ndarray]:
    """(forward, outer, turn), the time from a command to the truth, and the noise.

    The noise is the deviation per √s over windows of `NOISE`: of travel, of heading where the robot
    goes straight, and of heading per |ω| beyond that where it turns.
    """
    truth, (lines, _) = read_truth(folder, 1), read_robot(folder, 1)
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
    _, delay, turn = best
    columns = np.column_stack([told(v, delay, n), -told(np.abs(omega), delay, n)])
    forward, outer = np.linalg.lstsq(columns, along(FIT), rcond=None)[0]

    one = told(omega, delay, 1) * RATE
    step = path[1:, :2] - path[:-1, :2]
    middle = (heading[1:] + heading[:-1]) / 2
    off_along = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    off_along = off_along - forward * told(v, delay, 1) + outer * told(np.abs(omega), delay, 1)
    off_heading = np.diff(heading) - turn * one / RATE

    def density(error, rows):
        """Of the errors of these rows alone, per second in which there are any."""
        total = np.concatenate([[0], np.cumsum(np.where(rows, error, 0))])
        n = int(NOISE * RATE)
        gap = total[n:] - total[:-n]
        return np.sqrt((gap**2).mean() / NOISE / rows.mean())

    turning = np.abs(one) > 0.1
    going = (told(v, delay, 1) * RATE > 0.02) & (np.abs(one) < 0.05)
    straight = density(off_heading, going)
    omega_turning = turn * np.sqrt((one[turning] ** 2).mean())
    share = np.sqrt(density(off_heading, turning) ** 2 - straight**2) / omega_turning
    noise = np.array([density(off_along, np.ones(len(one), bool)), straight, share])
    return np.array([forward, outer, turn]), float(delay), noise


def fit(folder: Path) -> RobotCalibration:
    """The calibration; the camera's yaw is left at zero, since it differs from robot to robot."""
    (depth, ahead), shift, seen = camera(folder)
    (forward, outer, turn), delay, moved = odometry(folder)
    return RobotCalibration(delay - shift, forward, outer, turn, depth, ahead, 0.0, *moved, *seen)


def measure(folder: Path) -> list[Metric]:
    """The fit beside the constants of the package; a gate for the worst difference."""
    found, worst = fit(folder), 0.0
    print("| robot 1 of data set 6 | fitted | package |\n| --- | --- | --- |")
    for name, new, kept in zip(RobotCalibration._fields, found, MRCLAM_CALIBRATION, strict=True):
        print(f"| {name} | {new:.4f} | {kept:.4f} |")
        relative, absolute = TOLERANCE
        worst = max(worst, abs(new - kept) / max(relative * abs(kept), relative * absolute))
    return [Metric("constants off the fit, share of the tolerance", worst, high=1.0)]
