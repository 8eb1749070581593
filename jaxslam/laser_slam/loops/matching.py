"""Candidates matched: a keyframe in a submap, by correlation over a window and by lines."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam import programs
from jaxslam.laser_slam import poses
from jaxslam.laser_slam.loops.candidates import Candidates
from jaxslam.laser_slam.records import LoopOutcome
from jaxslam.laser_slam.scans import Scans
from jaxslam.laser_slam.search import Reference, Window, correlate, fit_lines, gathered, tables
from jaxslam.laser_slam.settings import Settings

NARROW = Window(turns=7, turn=float(np.deg2rad(2.0)), blocks=2, level=2, kept=64)
"""0.8 m and 14° to either side."""
WIDE = Window(turns=20, turn=float(np.deg2rad(2.0)), blocks=5, level=3, kept=256)
"""4 m and 40° to either side."""
LEVELS = 3
PEAK = 0.9
"""A pose elsewhere of this share of the best score makes a match ambiguous."""


class Matches(NamedTuple):
    """Candidates that were matched."""

    z: Float[np.ndarray, "M 3"]
    cov: Float[np.ndarray, "M 3 3"]
    """of the end of z"""
    score: Float[np.ndarray, "M"]
    outcome: Int[np.ndarray, "M"]
    """KEPT, POOR or AMBIGUOUS"""


def matched(
    scans: Scans,
    keyframe: Int[np.ndarray, "N"],
    path: Float[np.ndarray, "N 3"],
    candidates: Candidates,
    settings: Settings,
    progress: Callable[[], object],
) -> Matches:
    """The match of each candidate, submap by submap."""
    count = len(candidates.first)
    z, cov = np.zeros((count, 3)), np.zeros((count, 3, 3))
    score, outcome = np.zeros(count), np.zeros(count, int)
    for middle in np.unique(candidates.first):
        submap, levels = _submap(scans, keyframe, path, int(middle), settings)
        for row in np.flatnonzero(candidates.first == middle):
            scan = keyframe[candidates.second[row]]
            fit, best, other = programs.call(
                _in_wide if candidates.wide[row] else _in_narrow,
                (),
                submap,
                levels,
                scans.points[scan],
                scans.valid[scan],
                candidates.z[row].astype(np.float32),
            )
            z[row] = np.asarray(fit.pose, np.float64)
            cov[row] = poses.at_end(_cov(fit, settings), z[row])
            score[row] = fit.inliers
            if fit.inliers < settings.loop_inliers:
                outcome[row] = LoopOutcome.POOR
            elif float(other) > PEAK * float(best):
                outcome[row] = LoopOutcome.AMBIGUOUS
            progress()
    return Matches(z, cov, score, outcome)


def _submap(
    scans: Scans,
    keyframe: np.ndarray,
    path: np.ndarray,
    middle: int,
    settings: Settings,
) -> tuple[Reference, Any]:
    around = np.arange(middle - settings.submap, middle + settings.submap + 1)
    inside = (around >= 0) & (around < len(keyframe))
    around = np.clip(around, 0, len(keyframe) - 1)
    there = poses.between(path[middle], path[around]).astype(np.float32)
    of = keyframe[around]
    return programs.call(
        _prepare, (), scans.points[of], scans.normals[of], scans.valid[of] & inside[:, None], there
    )


def _cov(fit: Any, settings: Settings) -> Float[np.ndarray, "3 3"]:
    """Of the coordinates of a match: by its lines, and by the window where these say nothing."""
    sigma = max(settings.sigma, float(fit.residual)) ** 2 * settings.correlation
    edges = np.diag(1 / np.square([WIDE.distance, WIDE.distance, WIDE.turns * WIDE.turn]))
    cov = np.linalg.inv(np.asarray(fit.information, np.float64) / sigma + edges)
    return np.asarray(cov + np.diag(np.square(settings.floor)))


def _prepare(points: Array, normals: Array, valid: Array, there: Array) -> tuple[Reference, Any]:
    reference = gathered(points, normals, valid, there)
    return reference, tables(reference, LEVELS)


def _in(window: Window, submap: Reference, levels: Any, scan: Array, valid: Array, z: Array) -> Any:
    nothing = jnp.zeros((3, 3), jnp.float32)
    found = correlate(levels, scan[::2], valid[::2], z, nothing, window)
    return fit_lines(submap, scan, valid, found.pose, z, nothing), found.score, found.other


def _in_narrow(submap: Reference, levels: Any, scan: Array, valid: Array, z: Array) -> Any:
    return _in(NARROW, submap, levels, scan, valid, z)


def _in_wide(submap: Reference, levels: Any, scan: Array, valid: Array, z: Array) -> Any:
    return _in(WIDE, submap, levels, scan, valid, z)
