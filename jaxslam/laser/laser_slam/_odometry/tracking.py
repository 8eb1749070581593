"""Laser odometry: each scan against the keyframes before it, fused with raw odometry."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.laser.laser_slam._odometry.raw import FARTHEST, STEP_CHANGE, Steps, reach_cov
from jaxslam.laser.laser_slam._odometry.reference import (
    Reference,
    ScanMatch,
    match,
    reference_of,
    search,
    taken,
)
from jaxslam.laser.laser_slam._records import Settings
from jaxslam.laser.laser_slam._scan_points import Scans
from jaxslam.laser.matching import Correlative, Points
from jaxslam.math import numpy_poses as poses

NEAR = search(0.6, np.deg2rad(22.0), np.deg2rad(2.0), ambiguous=None)
"""About raw odometry."""
FAR = search(*FARTHEST, np.deg2rad(2.5))
"""The wider search, if the first finds little, or raw odometry is unusable."""
_INFLATION = 16.0
"""Of raw odometry's covariance in the wider search."""
_KEY_TURN = 0.35
"""Turn [rad] from the last keyframe above which a scan is one."""
_LEAST_INLIERS = 0.4
"""Share of a scan's points on the walls of the reference, for a match in odometry."""
LOOP_INLIERS = 0.65
"""The same for a loop."""
_MIN_INLIERS = 0.6
"""Share of points on walls below which the wider search is made, and a match is in doubt."""
_MIN_GAIN = 0.2
"""Extra share of points on walls, less those passed through, that the wider search must reach."""
_MAX_THROUGH = 0.15
"""Share of points that beams pass through, above which a match is of another place."""
_MAX_THROUGH_LIKELY = 0.4
"""The same about raw odometry, and where that is frozen: a pose without a match would be farther
off than most wrong matches, so these are taken, and are in doubt."""
_TOO_ODD = 3.0
"""Times the usual reach above which an odd step is believed only if its match is clearly better."""
_CLEAR_GAIN = 0.05
"""Extra share of points on walls, less those passed through, of a clearly better match."""
_DOUBT_GATE = 30.66
"""χ² of three degrees of freedom at 1 - 1e-6: a match farther from raw odometry is in doubt."""
_DOUBT_PROBABILITY = 0.1
"""Probability that a match in doubt is of another place."""
LOST = 6
"""Scans in a row without a match after which the next one is a keyframe without one."""
NO_FLOOR = np.zeros((3, 3))


class Odometry(NamedTuple):
    """Laser odometry of K scans: each relative to a keyframe, with its covariance."""

    poses: Float[np.ndarray, "K 3"]
    base: Int[np.ndarray, "K"]
    """the keyframe before each scan; for a keyframe, the previous one"""
    z: Float[np.ndarray, "K 3"]
    """the scan's pose in the frame of its base"""
    cov: Float[np.ndarray, "K 3 3"]
    """of the end of z, wider where a match is in doubt"""
    cov_if_right: Float[np.ndarray, "K 3 3"]
    """the same as if no match were in doubt"""
    keyframe: Int[np.ndarray, "N"]
    matched: Bool[np.ndarray, "K"]
    """false where z is raw odometry"""
    doubted: Bool[np.ndarray, "K"]
    """matched, but far from raw odometry, or with few points on walls"""
    inliers: Float[np.ndarray, "K"]
    """share of the points on walls, 0 without a match"""
    residual: Float[np.ndarray, "K"]
    """[m] root mean square of their distances from these"""
    refuted: Bool[np.ndarray, "K"]
    """raw odometry was too fast, and the scan matches where the robot was heading"""


def match_to_keyframes(
    scans: Scans, steps: Steps, settings: Settings, advance: Callable[[], object]
) -> Odometry:
    """The odometry of a piece of a log, from the pose zero, as `laser_odometry` describes it."""
    count = len(scans.usable)
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
        refuted=np.zeros(count, bool),
    )
    keys, since = [0], 0  # since: the keyframe from which on scans are matched with
    reference = _reference_of_last(scans, keys, result.poses, settings)
    # Of the last scan, relative to the last keyframe; doubt is added to its covariance.
    z, cov, doubt = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    missed, blind, last = 0, False, np.zeros(3)
    # Pose and covariance by raw odometry from before a step that lags, for the step after it.
    late: tuple[np.ndarray, np.ndarray] | None = None
    # The same from before steps that are frozen, or after one that a match contradicts: the next
    # may make up for them, or not.
    other: tuple[np.ndarray, np.ndarray] | None = None
    for scan in range(1, count):
        step, step_cov = steps.step[scan], steps.cov[scan]
        if steps.frozen[scan] or steps.reset[scan]:
            step = last  # the robot most likely goes on as it did
        begin, begin_cov = (z, cov) if late is None else late
        guess = poses.compose(begin, step)
        prior = end_covariances.composed_cov(begin_cov, step, step_cov)
        late = None
        if steps.lags[scan]:
            usual = step_cov - reach_cov(steps.reach[scan])
            late = guess, end_covariances.composed_cov(begin_cov, step, usual)
        blind = bool(blind or steps.unknown[scan])
        before, z, cov = z, guess, prior
        doubted = False
        found = None
        if scans.usable[scan] and reference is not None:
            points = taken(scans.points, scan)
            how = _How(
                bool(steps.gap[scan]), bool(blind or steps.lags[scan]), bool(steps.frozen[scan])
            )
            found = _matched(reference, points, guess, prior, steps.reach[scan], how, settings)
            if other is not None and not steps.unknown[scan]:
                prediction = poses.compose(other[0], step)
                wide = end_covariances.composed_cov(other[1], step, step_cov)
                back = _matched(
                    reference, points, prediction, wide, steps.reach[scan], how, settings
                )
                if back.accepted and back.quality > found.quality:
                    found, guess, prior = back, prediction, wide
            if steps.odd[scan]:
                onward = poses.compose(begin, last)
                change = step_cov + reach_cov(STEP_CHANGE * steps.usual_reach[scan])
                wide = end_covariances.composed_cov(begin_cov, last, change)
                unknown = how._replace(unknown=True)
                steady = _matched(
                    reference, points, onward, wide, steps.usual_reach[scan], unknown, settings
                )
                size = np.array([np.hypot(step[0], step[1]), abs(step[2])])
                too_odd = (size > _TOO_ODD * steps.usual_reach[scan]).any()
                gain = -_CLEAR_GAIN if too_odd else _CLEAR_GAIN
                better = steady.accepted and steady.quality > found.quality + gain
                if better and _contradicts(steady.pose, guess, prior):
                    result.refuted[scan] = True
                    found, guess, prior = steady, onward, wide
            result.inliers[scan] = found.inliers
            result.residual[scan] = found.residual
        if found is not None and found.accepted:
            result.matched[scan] = True
            z, cov = found.pose, found.cov
            contradicted = _contradicts(z, guess, found.prior)
            doubted = bool(contradicted or not found.sure)
            if steps.frozen[scan]:
                other = (begin, begin_cov) if other is None else other
            else:
                lied = contradicted and late is None and not steps.jump[scan]
                other = (guess, prior) if lied else None
            missed, blind = 0, False
        else:
            other = None
            missed += 1
            if steps.gap[scan]:
                cov = cov + reach_cov(steps.reach[scan])
        if steps.jump[scan] and not steps.reset[scan]:  # the next step may take it back
            spike = steps.logged[scan]
            other = (
                poses.compose(begin, spike),
                end_covariances.composed_cov(begin_cov, spike, step_cov),
            )
        last = poses.between(before, z)
        doubt = end_covariances.moved(doubt, last)
        if doubted and found is not None:
            doubt = _doubt(found.prior, poses.between(z, guess))
        result.doubted[scan] = doubted
        result.base[scan], result.z[scan] = keys[-1], z
        result.cov[scan] = cov + doubt
        # Nothing speaks for a match in doubt where odometry is frozen.
        result.cov_if_right[scan] = cov + doubt if steps.frozen[scan] else cov
        result.poses[scan] = poses.compose(result.poses[keys[-1]], z)
        far = np.hypot(z[0], z[1]) > settings.key_distance or abs(z[2]) > _KEY_TURN
        # Where odometry is frozen the robot is soon farther off than is searched.
        restart = missed > (0 if steps.frozen[scan] else LOST) or reference is None
        if scans.usable[scan] and (restart or (far and result.matched[scan])):
            keys.append(scan)
            if restart:
                since, missed, blind = scan, 0, False
            if late is not None:
                late = poses.between(z, late[0]), late[1] + cov
            if other is not None:
                other = poses.between(z, other[0]), other[1] + cov
            z, cov, doubt = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
            of = [key for key in keys if key >= since]
            reference = _reference_of_last(scans, of, result.poses, settings)
        advance()
    return result._replace(keyframe=np.array(keys))


class _Search(NamedTuple):
    """A match with raw odometry as its prior."""

    pose: Float[np.ndarray, "3"]
    cov: Float[np.ndarray, "3 3"]
    prior: Float[np.ndarray, "3 3"]
    """the covariance that raw odometry was taken to have"""
    inliers: float
    residual: float
    accepted: bool
    sure: bool
    """otherwise it is in doubt"""
    quality: float


class _How(NamedTuple):
    """What is known of a step of raw odometry."""

    gap: bool
    """it is long after the scan before"""
    unknown: bool
    """it is unusable as a guess"""
    frozen: bool
    """so are most likely those after it"""


def _matched(
    reference: Reference,
    points: Points,
    guess: Float[np.ndarray, "3"],
    prior: Float[np.ndarray, "3 3"],
    reach: Float[np.ndarray, "2"],
    how: _How,
    settings: Settings,
) -> _Search:
    """The match of a scan about raw odometry, or over all that the robot can have reached."""

    def by(matcher: Correlative, prior: np.ndarray) -> ScanMatch:
        return match(matcher, reference, points, guess, prior, NO_FLOOR, settings)

    least = _LEAST_INLIERS
    if how.unknown:
        fit = by(FAR, prior)
        sure = _sure(fit, settings)
        likely = fit.inliers >= least and fit.through <= _MAX_THROUGH_LIKELY
        accepted = sure or (how.frozen and likely)
    else:
        fit = by(NEAR, prior)
        if fit.inliers < _MIN_INLIERS:
            bound = reach_cov(reach)
            wide = by(FAR, _INFLATION * prior + bound)
            better = _sure(wide, settings) and _quality(wide) > _quality(fit) + _MIN_GAIN
            if better and _within_reach(wide, guess, prior, reach):
                fit = wide
                prior = prior + bound if how.gap else prior
        accepted = fit.inliers >= least and fit.through <= _MAX_THROUGH_LIKELY
        sure = fit.inliers >= _MIN_INLIERS
    parts = fit.pose, fit.cov, prior, fit.inliers, fit.residual
    return _Search(*parts, accepted, sure, _quality(fit))


def _sure(fit: ScanMatch, settings: Settings) -> bool:
    """Whether a match may be believed without raw odometry: as good as that of a loop."""
    good = fit.inliers >= LOOP_INLIERS and fit.through <= _MAX_THROUGH
    return good and not fit.ambiguous


def _within_reach(
    fit: ScanMatch,
    guess: Float[np.ndarray, "3"],
    prior: Float[np.ndarray, "3 3"],
    reach: Float[np.ndarray, "2"],
) -> bool:
    """Whether raw odometry is off by no more than the robot's reach plus 2 σ of raw odometry."""
    off, sigma = poses.between(guess, fit.pose), np.sqrt(prior.diagonal())
    near = np.hypot(off[0], off[1]) <= reach[0] + 2 * sigma[:2].max()
    return bool(near and abs(off[2]) <= reach[1] + 2 * sigma[2])


def _contradicts(
    pose: Float[np.ndarray, "3"], guess: Float[np.ndarray, "3"], prior: Float[np.ndarray, "3 3"]
) -> bool:
    """Whether a match is too far from raw odometry for its covariance."""
    off = poses.between(guess, pose)
    return bool(off @ np.linalg.solve(prior, off) > _DOUBT_GATE)


def _quality(fit: ScanMatch) -> float:
    return fit.inliers - fit.through


def _reference_of_last(
    scans: Scans, keys: list[int], path: Float[np.ndarray, "K 3"], settings: Settings
) -> Reference | None:
    """The last keyframes with enough points, in the frame of the last; None without any."""
    of = np.array([key for key in keys[-settings.reference :] if scans.usable[key]], int)
    if not len(of):
        return None
    return reference_of(scans, of, path[of], path[keys[-1]], settings.scans_of_reference)


def place_unmatched(result: Odometry, scans: Scans, steps: Steps, settings: Settings) -> None:
    """Match the scans without a match with the keyframes around them, in place.

    They are assumed midway between their neighbours, up to half the distance between these. A match
    that raw odometry contradicts must be as good as that of a loop, and is in doubt. The poses of
    the others do not change.
    """
    keys = result.keyframe
    placed = result.matched.copy()
    placed[keys] = True
    for scan in np.flatnonzero(~placed & scans.usable):
        row = int(np.searchsorted(keys, scan))
        base = keys[row - 1]
        if not placed[scan:].any():
            continue
        before = scan - 1 - int(np.argmax(placed[:scan][::-1]))
        after = scan + int(np.argmax(placed[scan:]))
        share = (scan - before) / (after - before)
        way = poses.between(result.poses[before], result.poses[after])
        middle = poses.compose(result.poses[before], share * way)
        half = settings.reference // 2
        of = keys[max(row - half, 0) : row + half]
        of = of[scans.usable[of]]
        if not len(of):
            continue
        path = result.poses
        reference = reference_of(scans, of, path[of], path[base], settings.scans_of_reference)
        guess = poses.between(path[base], middle)
        prior = steps.cov[scan] + reach_cov(np.array([np.hypot(way[0], way[1]), abs(way[2])]))
        points = taken(scans.points, scan)
        fit = match(FAR, reference, points, guess, prior, NO_FLOOR, settings)
        if fit.inliers < _MIN_INLIERS - 0.1 or fit.through > _MAX_THROUGH or fit.ambiguous:
            continue
        by_raw, raw_cov = result.z[scan].copy(), result.cov[scan].copy()
        contradicted = _contradicts(fit.pose, by_raw, raw_cov)
        if contradicted and not _sure(fit, settings):
            continue
        result.matched[scan], result.doubted[scan] = True, contradicted
        result.inliers[scan], result.residual[scan] = fit.inliers, fit.residual
        result.z[scan], result.cov[scan], result.cov_if_right[scan] = fit.pose, fit.cov, fit.cov
        if contradicted:
            result.cov[scan] += _doubt(raw_cov, poses.between(fit.pose, by_raw))
        result.poses[scan] = poses.compose(path[base], fit.pose)


def _doubt(prior: np.ndarray, off: np.ndarray) -> np.ndarray:
    """What is added to the covariance of a match that may be wrong: p (P + diag(d², d², t²)).

    By the distance d and the turn t to raw odometry, and not by e eᵀ, since of a wrong match not
    even the direction of its error is known.

    off: e, the mean of raw odometry seen from the match.
    """
    at_match = end_covariances.propagated(end_covariances.turns(off[2]), prior)
    far = off[0] ** 2 + off[1] ** 2
    return np.asarray(_DOUBT_PROBABILITY * (at_match + np.diag([far, far, off[2] ** 2])))
