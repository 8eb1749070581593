"""Errors of a path, pose by pose, against a reference; errors and entropy of a map."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.core.types import Estimate
from jaxslam.core.validation import InvalidField, refusals_of, require
from jaxslam.laser.grids import Grid, entropy
from jaxslam.laser.grids._grid import grid_map
from jaxslam.math.numpy_poses import compose, wrapped


class PathErrors(NamedTuple):
    """The errors of the poses of a path; `statistics` sums them up."""

    translation: Float[np.ndarray, "K"]
    """distance from the reference [m]"""
    rotation: Float[np.ndarray, "K"]
    """size of the angle to the reference [rad], in [0, π]"""
    frame: Float[np.ndarray, "3"]
    """pose that carries the path to where it is compared; zeros where it is not moved"""


def ate(reference: ArrayLike, estimate: ArrayLike, *, align: bool = True) -> PathErrors:
    """The absolute trajectory error: of each pose |t̂ - t| and |θ̂ - θ|, on the circle.

    Sturm, Engelhard, Endres, Burgard & Cremers 2012, "A benchmark for the evaluation of RGB-D SLAM
    systems", IROS; their figure is the RMSE of the translation.

    Args:
        reference, estimate: (K, 3) poses (x, y, θ); row k of one belongs to row k of the other.
        align: carry the estimate by the rigid motion that fits its positions best (`alignment`);
            otherwise both are in one frame.
    Raises:
        ValueError: on tables that are not K >= 1 finite poses each.
    """
    with refusals_of("ate"):
        true, path = pose_pair(reference, estimate)
    frame = alignment(path[:, :2], true[:, :2]) if align else np.zeros(3)
    path = transform(frame, path)
    gap = path - true
    return PathErrors(np.hypot(gap[:, 0], gap[:, 1]), np.abs(wrapped(gap[:, 2])), frame)


def alignment(source: ArrayLike, target: ArrayLike) -> Float[np.ndarray, "3"]:
    """The pose T that minimizes Σ |T·source_i - target_i|² over rigid motions, without scale.

    As `math.se2.align`, on the host in float64. source, target (N, 2); one point gives θ = 0.
    Raises ValueError on tables that are not N >= 1 finite points each.
    """
    with refusals_of("alignment"):
        p, q = _table("source", source, 2), _table("target", target, 2)
        _check_lengths(p, q)
    p0, q0 = p.mean(axis=0), q.mean(axis=0)
    a, b = p - p0, q - q0
    theta = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(theta), np.sin(theta)
    return np.array([q0[0] - c * p0[0] + s * p0[1], q0[1] - s * p0[0] - c * p0[1], theta])


def transform(frame: ArrayLike, rows: ArrayLike) -> Float[np.ndarray, "K n"]:
    """Poses (K, 3) or points (K, 2) of a frame, in the coordinates that its pose (3,) is in.

    Headings are wrapped to (-π, π]. Raises ValueError on other shapes and on numbers that are not
    finite.
    """
    with refusals_of("transform"):
        pose = _table("frame", np.reshape(np.asarray(frame, np.float64), (1, -1)), 3)
        table = _table("rows", rows, 3 if np.shape(rows)[-1:] == (3,) else 2)
    width = table.shape[1]
    return compose(pose, np.pad(table, ((0, 0), (0, 3 - width))))[:, :width]


def pose_pair(
    reference: ArrayLike, estimate: ArrayLike
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 3"]]:
    """Reference and estimate as finite tables (K, 3) in float64; InvalidField on others."""
    true, path = poses_of("reference", reference), poses_of("estimate", estimate)
    _check_lengths(true, path)
    return true, path


def poses_of(argument: str, poses: ArrayLike) -> Float[np.ndarray, "K 3"]:
    """A finite table (K, 3) in float64; raises InvalidField, with the argument, on others."""
    return _table(argument, poses, 3)


def _table(argument: str, values: ArrayLike, columns: int) -> Float[np.ndarray, "K n"]:
    rows = "poses (x, y, θ)" if columns == 3 else "points (x, y)"
    try:
        table = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise InvalidField(argument, f"expected a table of {rows}") from None
    if table.ndim != 2 or table.shape[1] != columns or len(table) == 0:
        raise InvalidField(argument, f"expected at least one of {rows}, got shape {table.shape}")
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise InvalidField(argument, f"expected finite {rows}, row {int(np.argmax(bad))} is not")
    return table


def _check_lengths(a: np.ndarray, b: np.ndarray) -> None:
    if len(a) != len(b):
        raise InvalidField(
            "", f"expected tables of the same length, got {len(a)} and {len(b)} rows"
        )


def align_map(
    estimate: Estimate, true_points: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """The pose that carries a map onto surveyed points best, and the RMSE [m] that remains.

    estimate: of one time, landmarks tagged. true_points: by tag. The frame of a map made from
    data begins at the robot's start, so only its shape can be compared (`alignment`). Raises
    ValueError if the map is empty.
    """
    named = np.asarray(estimate.alive) & (np.asarray(estimate.tag) >= 0)
    if not named.any():
        raise InvalidField("estimate", "it has no tagged landmark", owner="align_map")
    points = np.asarray(estimate.points, np.float64)[named]
    targets = np.asarray(true_points, np.float64)[np.asarray(estimate.tag)[named]]
    pose = alignment(points, targets)
    left = transform(pose, points) - targets
    return pose, float(np.sqrt((left**2).sum(axis=1).mean()))


def map_entropy(grid: Grid) -> float:
    """The mean entropy [bit] of the known cells of a map: 0 sure of each cell, 1 of none.

    Unknown cells, which have 1 bit each (`grids.entropy`), are left out, so that it does not depend
    on how much is around the map. Raises ValueError on a grid that is none or has no known cell.
    """
    with refusals_of("map_entropy"):
        require("grid", grid, grid_map)
    is_known = np.asarray(grid.log_odds) != 0
    if not is_known.any():
        raise InvalidField("grid", "it has no known cell", owner="map_entropy")
    return float(np.asarray(entropy(grid), np.float64)[is_known].mean())
