"""Candidates of loops, accepted or refused: a keyframe in a submap, by correlation and lines."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxslam.laser_slam.loops.candidates import Candidates
from jaxslam.laser_slam.odometry.reference import Reference, match, reference_of, search, taken
from jaxslam.laser_slam.records import LoopOutcome
from jaxslam.laser_slam.scans import Scans
from jaxslam.laser_slam.settings import Settings

NARROW, WIDE = (0.8, float(np.deg2rad(14.0))), (4.0, float(np.deg2rad(40.0)))
"""Windows of the search, [m] and [rad] to either side."""
SEARCHES = [search(*window, np.deg2rad(2.0)) for window in (NARROW, WIDE)]
WINDOW = np.diag(1 / np.square([WIDE[0], *WIDE]))
"""Information of the window, which bounds what the walls do not tell."""


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
        submap = _submap(scans, keyframe, path, int(middle), settings)
        rows = np.flatnonzero(candidates.first == middle)
        for row in rows:
            fit = match(
                SEARCHES[int(candidates.wide[row])],
                submap,
                taken(scans.points, keyframe[candidates.second[row]]),
                candidates.z[row],
                None,
                WINDOW,
                settings,
            )
            z[row], cov[row], score[row] = fit.pose, fit.cov, fit.inliers
            if fit.inliers < settings.loop_inliers:
                outcome[row] = LoopOutcome.POOR
            elif fit.ambiguous:
                outcome[row] = LoopOutcome.AMBIGUOUS
        return len(rows)

    submaps = np.unique(candidates.first)
    for _ in range(of_submap(submaps[0]) if count else 0):  # compiles what the others share
        progress()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for done in pool.map(of_submap, submaps[1:]):
                for _ in range(done):
                    progress()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return Matches(z, cov, score, outcome)


def _submap(
    scans: Scans, keyframe: np.ndarray, path: np.ndarray, middle: int, settings: Settings
) -> Reference:
    """The keyframes around one, in its frame."""
    low = max(middle - settings.submap, 0)
    around = np.arange(low, min(middle + settings.submap + 1, len(keyframe)))
    size = settings.scans_of_reference
    return reference_of(scans, keyframe[around], path[around], path[middle], size)
