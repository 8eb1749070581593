"""Candidates of loops, accepted or refused: a keyframe in a submap, by correlation and lines."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam import programs
from jaxslam.laser_slam import covariances
from jaxslam.laser_slam.loops.candidates import Candidates
from jaxslam.laser_slam.odometry.reference import (
    PEAK,
    Reference,
    gathered,
    on_walls,
    search,
    searched,
    taken,
    thinned,
)
from jaxslam.laser_slam.records import LoopOutcome
from jaxslam.laser_slam.scans import Scans
from jaxslam.laser_slam.settings import Settings
from jaxslam.matching import Match, Matcher, MatchStatus, Points
from jaxslam.matching.surface import Surface
from jaxslam.math import numpy_poses as poses

NARROW, WIDE = (0.8, float(np.deg2rad(14.0))), (4.0, float(np.deg2rad(40.0)))
"""Windows of the search, [m] and [rad] to either side."""
SEARCHES = [search(*window, np.deg2rad(2.0), ambiguous=PEAK) for window in (NARROW, WIDE)]


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
    """The match of each candidate, submap by submap, on every core."""
    count = len(candidates.first)
    z, cov = np.zeros((count, 3)), np.zeros((count, 3, 3))
    score, outcome = np.zeros(count), np.zeros(count, int)

    def of_submap(middle: np.integer) -> int:
        """The candidates of one submap; how many."""
        submap, prepared = _submap(scans, keyframe, path, int(middle), settings)
        rows = np.flatnonzero(candidates.first == middle)
        for row in rows:
            scan = keyframe[candidates.second[row]]
            fit, status = programs.call(
                _matched,
                (SEARCHES[int(candidates.wide[row])],),
                submap,
                prepared,
                taken(scans.points, scan),
                candidates.z[row].astype(np.float32),
            )
            z[row] = np.asarray(fit.pose, np.float64)
            cov[row] = covariances.at_end(_cov(fit, settings), z[row])
            score[row] = fit.inliers
            if fit.inliers < settings.loop_inliers:
                outcome[row] = LoopOutcome.POOR
            elif int(status) == MatchStatus.AMBIGUOUS:
                outcome[row] = LoopOutcome.AMBIGUOUS
        return len(rows)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for done in pool.map(of_submap, np.unique(candidates.first)):
                for _ in range(done):
                    progress()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return Matches(z, cov, score, outcome)


def _submap(
    scans: Scans,
    keyframe: np.ndarray,
    path: np.ndarray,
    middle: int,
    settings: Settings,
) -> tuple[Reference, Array]:
    around = np.arange(middle - settings.submap, middle + settings.submap + 1)
    inside = (around >= 0) & (around < len(keyframe))
    around = np.clip(around, 0, len(keyframe) - 1)
    there = poses.between(path[middle], path[around]).astype(np.float32)
    of = keyframe[around]
    points = taken(scans.points, of)
    points = points._replace(valid=points.valid & inside[:, None])
    return programs.call(_prepare, (), points, taken(scans.surface, of), there)


def _cov(fit: Match, settings: Settings) -> Float[np.ndarray, "3 3"]:
    """Of the coordinates of a match: by its lines, and by the window where these say nothing."""
    sigma = max(settings.sigma, float(fit.residual)) ** 2 * settings.correlation
    edges = np.diag(1 / np.square([WIDE[0], *WIDE]))
    cov = np.linalg.inv(covariances.semidefinite(np.asarray(fit.information)) / sigma + edges)
    return np.asarray(cov + np.diag(np.square(settings.floor)))


def _prepare(points: Points, surface: Surface, there: Array) -> tuple[Reference, Array]:
    reference = gathered(points, surface, there)
    return reference, searched(SEARCHES[0], reference)


def _matched(
    matcher: Matcher, submap: Reference, prepared: Array, scan: Points, z: Array
) -> tuple[Match, Array]:
    """By walls, from where a search ends; and the status of the search."""
    found = matcher.match(prepared, thinned(scan), z, None)
    return on_walls(submap, scan, found.pose, None), found.status
