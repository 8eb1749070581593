"""The scans of a log as points with the directions of their walls, and what of it is unusable."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from jaxslam import programs
from jaxslam.laser_slam.records import LogOfScans
from jaxslam.laser_slam.settings import Settings
from jaxslam.matching import Points
from jaxslam.matching.surface import Surface, surface

GAP = 0.5
"""[m] between points beyond which they are not of one wall"""


class Scans(NamedTuple):
    """K scans of B points, each in the frame of its robot; float32, as matching computes."""

    points: Points
    """(K, B), the robot's place where not valid"""
    surface: Surface
    """(K, B) the lines through them and their neighbours"""
    usable: Bool[np.ndarray, "K"]
    """enough points to match"""


def check_laser_log(name: str, log: LogOfScans) -> None:
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
    lost = np.asarray(log.beams.valid, bool) & ~np.isfinite(log.beams.angle)
    for what, bad in (
        ("raw odometry", ~np.isfinite(log.raw).all(axis=1)),
        ("the time", ~np.isfinite(log.time)),
        ("the angle of a valid beam", lost.any(axis=1)),
    ):
        if bad.any():
            raise ValueError(f"{name}: {what} of scan {int(bad.argmax())} is not finite")
    if not log.max_range > 0:
        raise ValueError(f"{name}: expected a max_range above 0, got {log.max_range}")


def scans_of(log: LogOfScans, settings: Settings) -> Scans:
    """The points of a log's scans, and the lines through those within two degrees of each."""
    ranges, angles, there = (np.asarray(part, np.float64) for part in log.beams)
    nearest = min(settings.max_range, log.max_range * (1 - 1e-6))
    with np.errstate(invalid="ignore"):
        valid = (there > 0) & (ranges > 0) & (ranges < nearest)
    ranges, angles = np.where(valid, ranges, 0.0), np.where(there > 0, angles, 0.0)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32)
    points: Any = ranges[..., None].astype(np.float32) * rays, rays, valid
    span = max(2, round(np.deg2rad(2.0) / max(_spacing(angles, there > 0), 1e-3)))
    stride = -(-ranges.shape[1] // settings.beams)
    lines = programs.call(_surfaces, (span,), Points(*points))
    kept, lines = jax.tree.map(lambda part: np.asarray(part)[:, ::stride], (Points(*points), lines))
    return Scans(kept, lines, usable=np.asarray(kept.valid).sum(axis=1) >= settings.fewest)


def _surfaces(span: int, points: Points) -> Surface:
    found: Surface = jax.vmap(lambda of: surface(of, span, GAP))(points)
    return found


def _spacing(angles: np.ndarray, there: np.ndarray) -> float:
    """The angle between beams [rad]."""
    steps = np.abs(np.diff(angles, axis=1))[there[:, 1:] & there[:, :-1]]
    return float(np.median(steps)) if steps.size else 0.02
