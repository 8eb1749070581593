"""The scans of a log as points with the directions of their walls, and what of it is unusable."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.laser_slam.records import LogOfScans
from jaxslam.laser_slam.settings import Settings


class Scans(NamedTuple):
    """K scans of B points, each in the frame of its robot; float32, as matching computes."""

    points: Float[np.ndarray, "K B 2"]
    """[m], (0, 0) where not valid"""
    normals: Float[np.ndarray, "K B 2"]
    """unit vector across the wall; (0, 0) where the neighbours are on no line"""
    valid: Bool[np.ndarray, "K B"]
    usable: Bool[np.ndarray, "K"]
    """enough points to match"""


def check_log(name: str, log: LogOfScans) -> None:
    """Raise ValueError, which begins with a caller's name, unless a log can be used."""
    shape = np.shape(log.beams.range)
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"{name}: expected ranges (scans, beams), at least one, got {shape}")
    if np.shape(log.beams.angle) != shape or np.shape(log.beams.valid) != shape:
        raise ValueError(f"{name}: expected angles and masks {shape}, as the ranges have")
    if np.shape(log.raw) != (shape[0], 3):
        raise ValueError(
            f"{name}: expected raw odometry (x, y, θ) at each of {shape[0]} scans, got "
            f"{np.shape(log.raw)}"
        )
    if np.shape(log.time) != (shape[0],):
        raise ValueError(f"{name}: expected {shape[0]} times, got {np.shape(log.time)}")
    if not np.all(np.isfinite(log.raw)):
        scan = int((~np.isfinite(log.raw)).any(axis=1).argmax())
        raise ValueError(f"{name}: raw odometry of scan {scan} is not finite")
    if not log.max_range > 0:
        raise ValueError(f"{name}: expected a max_range above 0, got {log.max_range}")


def scans_of(log: LogOfScans, settings: Settings) -> Scans:
    """The points of a log's scans.

    A normal is the direction of least spread of the points within two degrees (at least two beams)
    to either side, where these follow each other without a gap, and lie on a line within a tenth of
    its length.
    """
    ranges, angles, there = (np.asarray(part, np.float64) for part in log.beams)
    nearest = min(settings.max_range, log.max_range * (1 - 1e-6))
    with np.errstate(invalid="ignore"):
        valid = (there > 0) & (ranges > 0) & (ranges < nearest)
    ranges = np.where(valid, ranges, 0.0)
    points = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    normals = _normals(points, valid, ranges, _spacing(angles, there > 0))
    stride = -(-points.shape[1] // settings.beams)
    kept = slice(None, None, stride)
    found: Any = (
        points[:, kept].astype(np.float32),
        normals[:, kept].astype(np.float32),
        valid[:, kept],
        valid[:, kept].sum(axis=1) >= settings.fewest,
    )
    return Scans(*found)


def _spacing(angles: np.ndarray, there: np.ndarray) -> float:
    """The angle between beams [rad]."""
    steps = np.abs(np.diff(angles, axis=1))[there[:, 1:] & there[:, :-1]]
    return float(np.median(steps)) if steps.size else 0.02


def _normals(
    points: np.ndarray, valid: np.ndarray, ranges: np.ndarray, spacing: float
) -> np.ndarray:
    span = max(2, round(np.deg2rad(2.0) / max(spacing, 1e-3)))
    near = np.maximum(0.15, 4 * spacing * ranges)  # a longer step to the next point is a gap
    weight = valid.astype(float)
    total, first = weight.copy(), weight[..., None] * points
    moments = {"xx": points[..., 0] ** 2, "yy": points[..., 1] ** 2}
    moments["xy"] = points[..., 0] * points[..., 1]
    second = {key: weight * value for key, value in moments.items()}
    for direction in (1, -1):
        linked = valid.copy()
        for k in range(1, span + 1):
            there = np.roll(points, -direction * k, axis=1)
            before = np.roll(points, -direction * (k - 1), axis=1)
            linked = linked & np.roll(valid, -direction * k, axis=1)
            linked = linked & (np.linalg.norm(there - before, axis=-1) < near)
            edge = np.arange(points.shape[1]) + direction * k
            linked = linked & (edge >= 0) & (edge < points.shape[1])
            total += linked
            first += linked[..., None] * there
            second["xx"] += linked * there[..., 0] ** 2
            second["yy"] += linked * there[..., 1] ** 2
            second["xy"] += linked * there[..., 0] * there[..., 1]
    count = np.maximum(total, 1.0)
    mean = first / count[..., None]
    xx = second["xx"] / count - mean[..., 0] ** 2
    yy = second["yy"] / count - mean[..., 1] ** 2
    xy = second["xy"] / count - mean[..., 0] * mean[..., 1]
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    half = np.hypot(0.5 * (xx - yy), xy)
    least, most = 0.5 * (xx + yy) - half, 0.5 * (xx + yy) + half
    line = valid & (total >= 3) & (least < 0.01 * most)
    return np.where(line[..., None], np.stack([-np.sin(along), np.cos(along)], axis=-1), 0.0)
