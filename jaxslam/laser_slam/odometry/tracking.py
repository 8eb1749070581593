"""Laser odometry: each scan against the keyframes before it, fused with raw odometry."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam import programs
from jaxslam.laser_slam import covariances
from jaxslam.laser_slam.odometry.raw import Steps
from jaxslam.laser_slam.odometry.reference import (
    BLUR,
    PEAK,
    gathered,
    on_walls,
    search,
    searched,
    taken,
    thinned,
)
from jaxslam.laser_slam.scans import Scans
from jaxslam.laser_slam.settings import Settings
from jaxslam.matching import Match, Matcher, MatchStatus, Points, Prior
from jaxslam.matching.surface import Surface
from jaxslam.math import numpy_poses as poses

NEAR = search(0.6, np.deg2rad(22.0), np.deg2rad(2.0))
"""About raw odometry."""
FAR = search(1.6, np.deg2rad(60.0), np.deg2rad(2.5))
"""Where that finds little, with raw odometry's covariance times `DOUBT`."""
LOST = search(2.0, np.deg2rad(100.0), np.deg2rad(2.5), ambiguous=PEAK)
"""Where raw odometry is no guess, as after a jump: the match must be as good as that of a loop."""
WIDE = 0.3
"""[m] standard deviation of raw odometry's position from which on it is none"""
DOUBT = 16.0
SURE = 0.6
"""Share of the points on walls below which the wider search is made."""
BETTER = 0.1
"""By how much more its share has to be."""
GATE = 30.66
"""χ² of three degrees of freedom at 1 - 1e-6: a match farther from raw odometry is in doubt."""
WRONG = 0.1
"""Probability that a match in doubt is of another place."""


class Odometry(NamedTuple):
    """Laser odometry of K scans: each relative to a keyframe, with its covariance."""

    poses: Float[np.ndarray, "K 3"]
    base: Int[np.ndarray, "K"]
    """the keyframe before each scan; of a keyframe, the one before it"""
    z: Float[np.ndarray, "K 3"]
    """the scan's pose in the frame of its base"""
    cov: Float[np.ndarray, "K 3 3"]
    """of the end of z, wider where a match is in doubt"""
    cov_if_right: Float[np.ndarray, "K 3 3"]
    """the same as if no match were in doubt"""
    keyframe: Int[np.ndarray, "N"]
    matched: Bool[np.ndarray, "K"]
    """false where z is raw odometry alone"""
    doubted: Bool[np.ndarray, "K"]
    """matched, but far from raw odometry, or with few points on walls"""
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
    by `settings.correlation`. Where too few points meet a wall the step is raw odometry alone; so
    it is where that is no guess, as after a jump, and the match is worse than that of a loop, or
    another pose is nearly as good.

    A match is in doubt that has few points on walls, or that raw odometry contradicts: it may be of
    another place that looks the same. It stays, and is taken to be wrong with probability p = 0.1:
    its covariance is about that of the mixture with raw odometry, C + p (P + e eᵀ), where e leads
    from one to the other. So are those of the scans after it until the next keyframe.
    """
    count, width = len(scans.usable), settings.reference
    result = Odometry(
        poses=np.zeros((count, 3)),
        base=np.zeros(count, int),
        z=np.zeros((count, 3)),
        cov=np.zeros((count, 3, 3)),
        cov_if_right=np.zeros((count, 3, 3)),
        keyframe=np.zeros(0, int),
        matched=np.zeros(count, bool),
        doubted=np.zeros(count, bool),
        inliers=np.zeros(count),
        residual=np.zeros(count),
    )
    result.poses[0] = first
    keys = [0]
    # Of the last scan, relative to the last keyframe; doubt is what is added to its covariance.
    z, cov, doubt = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    for scan in range(1, count):
        key = keys[-1]
        guess = poses.compose(z, steps.step[scan])
        prior = covariances.composed_cov(cov, steps.step[scan], steps.cov[scan])
        of = [one for one in keys[-width:] if scans.usable[one]]
        before, z, cov = z, guess, prior
        doubted = False
        if scans.usable[scan] and of:

            def tracked(matcher: Matcher, prior: np.ndarray) -> _Tracked:
                return _tracked(matcher, scans, scan, of, result.poses, key, guess, prior, settings)  # noqa: B023

            least = settings.least_inliers
            if np.sqrt(prior.diagonal()[:2].max()) > WIDE:
                found, least = tracked(LOST, prior), max(least, settings.loop_inliers)
            else:
                found = tracked(NEAR, prior)
                if found.match.inliers < SURE:
                    wider = tracked(FAR, DOUBT * prior)
                    if wider.match.inliers > found.match.inliers + BETTER:
                        found = wider
            fit = found.match
            result.inliers[scan], result.residual[scan] = fit.inliers, fit.residual
            if fit.inliers >= least and not found.ambiguous:
                result.matched[scan] = True
                z, cov = np.asarray(fit.pose, np.float64), found.cov
                off = poses.between(guess, z)
                contradicted = off @ np.linalg.solve(prior, off) > GATE
                doubted = bool(contradicted or fit.inliers < SURE)
        doubt = covariances.moved(doubt, poses.between(before, z))
        if doubted:
            doubt = _doubt(prior, poses.between(z, guess))
        result.doubted[scan] = doubted
        result.base[scan], result.z[scan] = key, z
        result.cov[scan], result.cov_if_right[scan] = cov + doubt, cov
        result.poses[scan] = poses.compose(result.poses[key], z)
        far = np.hypot(z[0], z[1]) > settings.key_distance or abs(z[2]) > settings.key_turn
        if far and scans.usable[scan]:
            keys.append(scan)
            z, cov, doubt = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        if progress is not None:
            progress(scan + 1, count)
    return result._replace(keyframe=np.array(keys))


def _doubt(prior: np.ndarray, off: np.ndarray) -> np.ndarray:
    """What is added to the covariance of a match that may be wrong: p (P + e eᵀ).

    off: e, the mean of raw odometry seen from the match.
    """
    at_match = covariances.propagated(covariances.turns(off[2]), prior)
    return WRONG * (at_match + np.outer(off, off))


class _Tracked(NamedTuple):
    """A match of a scan with the keyframes before it."""

    match: Match
    cov: Float[np.ndarray, "3 3"]
    """of the end of its pose"""
    ambiguous: bool
    """whether the search found another pose nearly as good"""


def _tracked(
    matcher: Matcher,
    scans: Scans,
    scan: int,
    of: list[int],
    path: np.ndarray,
    key: int,
    guess: np.ndarray,
    prior: np.ndarray,
    settings: Settings,
) -> _Tracked:
    """The match of a scan with keyframes, in the frame of the last."""
    take = np.array(of + [of[-1]] * (settings.reference - len(of)))
    there = poses.between(path[key], path[take]).astype(np.float32)
    points = taken(scans.points, take)
    again = np.arange(len(take)) < len(of)  # padding repeats a keyframe without points
    wide = covariances.of_coordinates(prior, guess)
    fit, status = programs.call(
        _track,
        (matcher,),
        points._replace(valid=points.valid & again[:, None]),
        taken(scans.surface, take),
        there,
        taken(scans.points, scan),
        guess.astype(np.float32),
        (settings.correlation * np.linalg.inv(wide)).astype(np.float32),
        np.float32(settings.sigma),
    )
    sigma = max(settings.sigma, float(fit.residual)) ** 2 * settings.correlation
    seen = covariances.semidefinite(np.asarray(fit.information)) / sigma + np.linalg.inv(wide)
    at_end = covariances.at_end(np.linalg.inv(seen), np.asarray(fit.pose, np.float64))
    cov = at_end + np.diag(np.square(settings.floor))
    return _Tracked(fit, cov, int(status) == MatchStatus.AMBIGUOUS)


def _track(
    matcher: Matcher,
    points: Points,
    surface: Surface,
    there: Array,
    scan: Points,
    guess: Array,
    information: Array,
    sigma: Array,
) -> tuple[Match, Array]:
    """By a search and by walls, with a prior of so much information beside points of variance 1;
    and the status of the search."""
    reference = gathered(points, surface, there)
    prepared = searched(matcher, reference)
    coarse = Prior(guess, BLUR**2 * information)
    found = matcher.match(prepared, thinned(scan), guess, coarse)
    near = on_walls(reference, scan, found.pose, Prior(guess, sigma**2 * information))
    return near, found.status
