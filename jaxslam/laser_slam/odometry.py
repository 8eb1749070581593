"""Laser odometry: each scan against the keyframes before it, fused with raw odometry."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam import programs
from jaxslam.laser_slam import poses
from jaxslam.laser_slam.raw_odometry import Steps
from jaxslam.laser_slam.scans import Scans
from jaxslam.laser_slam.search import Window, correlate, fit_lines, gathered, tables
from jaxslam.laser_slam.settings import Settings

NEAR = Window(turns=11, turn=float(np.deg2rad(2.0)), blocks=3, level=1, kept=64)
"""The search about raw odometry: 0.6 m and 22° to either side."""
FAR = Window(turns=24, turn=float(np.deg2rad(2.5)), blocks=2, level=3, kept=256)
"""Where that finds little: 1.6 m and 60°, with raw odometry's covariance times `DOUBT`."""
DOUBT = 16.0
SURE = 0.6
"""Share of the points on walls below which the wider search is made."""
BETTER = 0.1
"""By how much more its share has to be."""


class Odometry(NamedTuple):
    """Laser odometry of K scans: each relative to a keyframe, with its covariance."""

    poses: Float[np.ndarray, "K 3"]
    base: Int[np.ndarray, "K"]
    """the keyframe before each scan; of a keyframe, the one before it"""
    z: Float[np.ndarray, "K 3"]
    """the scan's pose in the frame of its base"""
    cov: Float[np.ndarray, "K 3 3"]
    """of the end of z"""
    keyframe: Int[np.ndarray, "N"]
    matched: Bool[np.ndarray, "K"]
    """false where z is raw odometry alone"""
    inliers: Float[np.ndarray, "K"]
    """share of the points on walls, 0 where none were matched"""
    residual: Float[np.ndarray, "K"]
    """[m] root mean square of their distances from these"""


def laser_odometry(
    scans: Scans,
    steps: Steps,
    settings: Settings,
    first: Float[np.ndarray, "3"],
    progress: Callable[[int, int], object] | None = None,
) -> Odometry:
    """The path of a log's scans, each matched with the last keyframes and fused with raw odometry.

    The pose in the frame of the last keyframe minimizes the squared distances of the points from
    the lines of the reference, and the error of raw odometry from the scan before, by their
    covariances; its covariance is (H/σ² + P⁻¹)⁻¹ + floor², H the information of the lines divided
    by `settings.correlation`. Where too few points meet a wall the step is raw odometry alone.
    """
    count, width = len(scans.points), settings.reference
    result = Odometry(
        poses=np.zeros((count, 3)),
        base=np.zeros(count, int),
        z=np.zeros((count, 3)),
        cov=np.zeros((count, 3, 3)),
        keyframe=np.zeros(0, int),
        matched=np.zeros(count, bool),
        inliers=np.zeros(count),
        residual=np.zeros(count),
    )
    result.poses[0] = first
    keys = [0]
    z, cov = np.zeros(3), np.zeros((3, 3))  # of the last scan, relative to the last keyframe
    for scan in range(1, count):
        key = keys[-1]
        guess = poses.compose(z, steps.step[scan])
        prior = poses.composed_cov(cov, steps.step[scan], steps.cov[scan])
        of = [one for one in keys[-width:] if scans.usable[one]]
        z, cov = guess, prior
        if scans.usable[scan] and of:
            fit, seen = _tracked(NEAR, scans, scan, of, result.poses, key, guess, prior, settings)
            if fit.inliers < SURE:
                wider = _tracked(
                    FAR, scans, scan, of, result.poses, key, guess, DOUBT * prior, settings
                )
                if wider[0].inliers > fit.inliers + BETTER:
                    fit, seen = wider
            result.inliers[scan], result.residual[scan] = fit.inliers, fit.residual
            if fit.inliers >= settings.least_inliers:
                result.matched[scan] = True
                z, cov = np.asarray(fit.pose, np.float64), seen
        result.base[scan], result.z[scan], result.cov[scan] = key, z, cov
        result.poses[scan] = poses.compose(result.poses[key], z)
        far = np.hypot(z[0], z[1]) > settings.key_distance or abs(z[2]) > settings.key_turn
        if far and scans.usable[scan]:
            keys.append(scan)
            z, cov = np.zeros(3), np.zeros((3, 3))
        if progress is not None:
            progress(scan + 1, count)
    return result._replace(keyframe=np.array(keys))


def _tracked(
    window: Window,
    scans: Scans,
    scan: int,
    of: list[int],
    path: np.ndarray,
    key: int,
    guess: np.ndarray,
    prior: np.ndarray,
    settings: Settings,
) -> tuple[Any, np.ndarray]:
    """The fit of a scan to keyframes in the frame of the last, and the covariance of its end."""
    take = np.array(of + [of[-1]] * (settings.reference - len(of)))
    there = poses.between(path[key], path[take]).astype(np.float32)
    again = np.arange(len(take)) < len(of)  # padding repeats a keyframe without points
    wide = poses.of_coordinates(prior, guess)
    information = np.linalg.inv(wide)
    fit = programs.call(
        _track,
        (window,),
        scans.points[take],
        scans.normals[take],
        scans.valid[take] & again[:, None],
        there,
        scans.points[scan],
        scans.valid[scan],
        guess.astype(np.float32),
        information.astype(np.float32),
        np.float32(settings.sigma**2 * settings.correlation),
    )
    sigma = max(settings.sigma, float(fit.residual)) ** 2 * settings.correlation
    seen = np.asarray(fit.information, np.float64) / sigma + np.linalg.inv(wide)
    at_end = poses.at_end(np.linalg.inv(seen), np.asarray(fit.pose, np.float64))
    return fit, at_end + np.diag(np.square(settings.floor))


def _track(
    window: Window,
    points: Array,
    normals: Array,
    valid: Array,
    there: Array,
    scan: Array,
    scan_valid: Array,
    guess: Array,
    information: Array,
    weight: Array,
) -> Any:
    reference = gathered(points, normals, valid, there)
    levels = tables(reference, window.level)
    found = correlate(levels, scan[::2], scan_valid[::2], guess, information, window)
    return fit_lines(reference, scan, scan_valid, found.pose, guess, weight * information)
