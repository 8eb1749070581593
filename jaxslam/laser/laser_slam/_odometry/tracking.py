"""Laser odometry: each scan against the keyframes before it, fused with raw odometry.

`step` leads the `Track` from one scan to the next, and `match_to_keyframes` along a log.
"""

from collections.abc import Callable
from enum import Enum
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
    rows_of,
    window_search,
)
from jaxslam.laser.laser_slam._records import Settings
from jaxslam.laser.laser_slam._scan_points import Scans
from jaxslam.laser.matching import Points
from jaxslam.math import numpy_poses as poses

# Constants without another origin were chosen on the logs intel, edmonton, freiburg-101 and CSAIL.
NEAR = window_search(0.6, np.deg2rad(22.0), np.deg2rad(2.0), ambiguous=None)
"""Search about raw odometry: 2 σ of a step of 2.7 m straight on, and 2 σ of a turn of 1 rad."""
FAR = window_search(*FARTHEST, np.deg2rad(2.5))
"""Search of all poses in reach, if the near search finds little or raw odometry is unusable."""
_INFLATION = 16.0
"""Factor on the covariance of raw odometry in the wider search: 4 σ."""
_KEY_TURN = 0.35
"""Turn [rad] from the last keyframe above which a scan is a keyframe."""
_LEAST_INLIERS = 0.4
"""Least share of a scan's points on the walls of the reference, for any match of odometry."""
LOOP_INLIERS = 0.65
"""Least share of points on walls for a loop, and for a match that raw odometry does not support.

After a jump, wrong poses had up to two thirds of their points on walls; `_MAX_THROUGH` refuses
these."""
_MIN_INLIERS = 0.6
"""Share of points on walls below which the wider search is made, and a match is in doubt."""
_MIN_GAIN = 0.2
"""Gain of quality over the near search that the wider search must reach."""
_MAX_THROUGH = 0.15
"""Share of the reference's points that beams pass through, above which a match is of another place.

It is at most 0.08 in 98 % of right matches of CSAIL, and 0.2 or more in wrong ones."""
_MAX_THROUGH_LIKELY = 0.4
"""Like `_MAX_THROUGH`, but for searches about raw odometry or while odometry is frozen. Here a
doubtful match is usually closer than no match, so it is accepted and marked as doubtful."""
_TOO_ODD = 3.0
"""Times the usual reach above which an odd step is believed only if its match is clearly better."""
_CLEAR_GAIN = 0.05
"""Gain of quality of a clearly better match."""
_DOUBT_GATE = 30.66
"""χ² of three degrees of freedom at 1 - 1e-6: a match farther from raw odometry is in doubt."""
_DOUBT_PROBABILITY = 0.1
"""Assumed probability that a match in doubt is of another place."""
_LATER_INLIERS = 0.5
"""Least share of points on walls for a scan that is placed between its neighbours. It is below
`_MIN_INLIERS`, since keyframes on both sides bound the pose."""
LOST_AFTER = 6
"""Scans in a row without a match after which the next scan is a keyframe without a match."""
NO_FLOOR = np.zeros((3, 3))
"""Information added to a match: none."""


class Odometry(NamedTuple):
    """Laser odometry of K scans: the pose of each relative to a keyframe, with its covariance."""

    poses: Float[np.ndarray, "K 3"]
    base: Int[np.ndarray, "K"]
    """keyframe before each scan; for a keyframe, the previous one"""
    z: Float[np.ndarray, "K 3"]
    """pose of the scan in the frame of its base"""
    cov: Float[np.ndarray, "K 3 3"]
    """covariance of the end of `z`, inflated if the match is doubtful"""
    cov_if_right: Float[np.ndarray, "K 3 3"]
    """covariance of the end of `z` if no match were doubtful"""
    keyframe: Int[np.ndarray, "N"]
    """scans that are keyframes, in ascending order"""
    matched: Bool[np.ndarray, "K"]
    """false where `z` is raw odometry"""
    doubted: Bool[np.ndarray, "K"]
    """matched, but far from raw odometry, or with few points on walls"""
    inliers: Float[np.ndarray, "K"]
    """share of the points on walls, 0 without a match"""
    residual: Float[np.ndarray, "K"]
    """[m] root mean square distance of the inliers from their walls"""
    refuted: Bool[np.ndarray, "K"]
    """raw odometry was too fast, and the scan matches where the robot was heading"""


class Mode(Enum):
    """The mode of the tracking: where the match of the next scan is searched for."""

    STARTING = "no keyframe has points yet"
    TRACKING = "raw odometry leads here from the last match: search about it"
    BLIND = "raw odometry was unusable since the last match: search all that is in reach"


class RelativeEstimate(NamedTuple):
    """A pose relative to the last keyframe."""

    pose: Float[np.ndarray, "3"]
    cov: Float[np.ndarray, "3 3"]
    """covariance of the end of the pose"""

    def move(
        self, step: Float[np.ndarray, "3"], cov: Float[np.ndarray, "3 3"]
    ) -> "RelativeEstimate":
        """The estimate after an independent step with the covariance of its end."""
        end_cov = end_covariances.composed_cov(self.cov, step, cov)
        return RelativeEstimate(poses.compose(self.pose, step), end_cov)

    def seen_from(self, keyframe: "RelativeEstimate") -> "RelativeEstimate":
        """The estimate relative to a new keyframe, both taken as independent, which is cautious."""
        return RelativeEstimate(poses.between(keyframe.pose, self.pose), self.cov + keyframe.cov)


class Keyframe(NamedTuple):
    """A scan that others are matched with."""

    scan: int
    pose: Float[np.ndarray, "3"]
    """pose in the frame of the first scan"""


class Track(NamedTuple):
    """The state of laser odometry after a scan."""

    mode: Mode
    at: RelativeEstimate
    """the robot, relative to the last keyframe"""
    doubt: Float[np.ndarray, "3 3"]
    """part of the covariance due to matches in doubt since the last keyframe, not in `at`"""
    motion: Float[np.ndarray, "3"]
    """motion from the previous scan"""
    missed: int
    """scans in a row without a match"""
    before_lag: RelativeEstimate | None
    """the robot before a step that lags, moved by it: the next step is right only from here"""
    alternative: RelativeEstimate | None
    """another pose from which the next scan is matched too; see `_alternative_of`"""
    keyframes: tuple[Keyframe, ...]
    """the last keyframes, `Settings.reference` at most"""
    reference: Reference
    """the points of the keyframes that have enough, in the frame of the last one"""


class Row(NamedTuple):
    """`Odometry` of one scan; the fields have the same names."""

    poses: Float[np.ndarray, "3"]
    base: int
    z: Float[np.ndarray, "3"]
    cov: Float[np.ndarray, "3 3"]
    cov_if_right: Float[np.ndarray, "3 3"]
    keyframe: bool
    matched: bool
    doubted: bool
    inliers: float
    residual: float
    refuted: bool


def match_to_keyframes(
    scans: Scans, steps: Steps, settings: Settings, advance: Callable[[], object]
) -> Odometry:
    """The odometry of a piece of a log, from the pose zero, as `laser_odometry` describes it."""
    zero, no_cov = np.zeros(3), np.zeros((3, 3))
    first = (Keyframe(0, zero),)
    track = Track(
        mode=Mode.TRACKING if scans.usable[0] else Mode.STARTING,
        at=RelativeEstimate(zero, no_cov),
        doubt=no_cov,
        motion=zero,
        missed=0,
        before_lag=None,
        alternative=None,
        keyframes=first,
        reference=_reference_of(first, scans, settings),
    )
    start = Row(
        poses=zero,
        base=0,
        z=zero,
        cov=no_cov,
        cov_if_right=no_cov,
        keyframe=True,
        matched=False,
        doubted=False,
        inliers=0.0,
        residual=0.0,
        refuted=False,
    )
    rows = [start]
    for scan in range(1, len(scans.usable)):
        track, row = step(track, scan, scans, steps, settings)
        rows.append(row)
        advance()
    result = Odometry(*(np.array(column) for column in zip(*rows, strict=True)))
    return result._replace(keyframe=np.flatnonzero(result.keyframe))


def step(
    track: Track, scan: int, scans: Scans, steps: Steps, settings: Settings
) -> tuple[Track, Row]:
    """The track after the next scan, and the odometry of the scan.

    Predict by raw odometry, match, judge, and make the scan a keyframe if it is far from the last:

    | mode before | raw odometry | match | lost | mode after, and the scan |
    |---|---|---|---|---|
    | STARTING | any | not tried | always | TRACKING, keyframe |
    | TRACKING, BLIND | any | accepted | no | TRACKING, keyframe if it is far |
    | TRACKING | known | none | no | TRACKING |
    | TRACKING | unknown | none | no | BLIND |
    | BLIND | any | none | no | BLIND |
    | TRACKING, BLIND | any | none | yes | TRACKING, the only keyframe |

    Lost: more than `LOST_AFTER` scans in a row have no match, or any if raw odometry is frozen. A
    scan with too few points is neither tried nor a keyframe: STARTING stays, and a lost robot goes
    on by raw odometry until a scan with points has no match either.
    """
    raw, usable = rows_of(steps, scan), bool(scans.usable[scan])
    mode = Mode.BLIND if track.mode is Mode.TRACKING and raw.unknown else track.mode

    # Predict. Where raw odometry is frozen or set anew, the robot most likely goes on as it did.
    begin = track.at if track.before_lag is None else track.before_lag
    ahead = track.motion if raw.frozen or raw.reset else raw.step
    predicted = begin.move(ahead, raw.cov)
    before_lag = begin.move(ahead, raw.cov - reach_cov(raw.reach)) if raw.lags else None

    # Match, from the prediction and from what else is possible.
    fit = _NO_MATCH
    if usable and mode is not Mode.STARTING:
        fit = _best_match(track, mode, begin, predicted, raw, rows_of(scans.points, scan), settings)

    # Judge.
    doubted = fit.accepted and (fit.contradicts_raw or not fit.sure)
    if fit.accepted:
        mode, missed, at = Mode.TRACKING, 0, RelativeEstimate(fit.pose, fit.cov)
    else:
        missed, at = track.missed + 1, predicted
        if raw.gap:  # steps of the pause may be missing from raw odometry
            at = at._replace(cov=at.cov + reach_cov(raw.reach))
    motion = poses.between(track.at.pose, at.pose)
    doubt = end_covariances.move(track.doubt, motion)
    if doubted:  # replaces earlier doubt, since the next scans depend on this match
        doubt = _doubt_cov(fit.prior_cov, poses.between(fit.pose, fit.guess.pose))
    last = track.keyframes[-1]
    row = Row(
        poses=poses.compose(last.pose, at.pose),
        base=last.scan,
        z=at.pose,
        cov=at.cov + doubt,
        # Nothing speaks for a match in doubt where odometry is frozen.
        cov_if_right=at.cov + doubt if raw.frozen else at.cov,
        keyframe=False,
        matched=fit.accepted,
        doubted=doubted,
        inliers=fit.inliers,
        residual=fit.residual,
        refuted=fit.refutes_raw,
    )
    after = track._replace(
        mode=mode,
        at=at,
        doubt=doubt,
        motion=motion,
        missed=missed,
        before_lag=before_lag,
        alternative=_alternative_of(track, begin, raw, fit),
    )

    # Make a keyframe. Where odometry is frozen the robot is soon farther off than is searched.
    lost = mode is Mode.STARTING or missed > (0 if raw.frozen else LOST_AFTER)
    far = np.hypot(*at.pose[:2]) > settings.key_distance or abs(at.pose[2]) > _KEY_TURN
    if usable and (lost or (fit.accepted and far)):
        after = _at_keyframe(after, Keyframe(scan, row.poses), lost, scans, settings)
        row = row._replace(keyframe=True)
    return after, row


def _at_keyframe(
    track: Track, keyframe: Keyframe, lost: bool, scans: Scans, settings: Settings
) -> Track:
    """The track relative to a new keyframe, which is the only one if the robot was lost."""
    before = () if lost else track.keyframes
    keyframes = (*before, keyframe)[-settings.reference :]
    at, lag, alternative = track.at, track.before_lag, track.alternative
    return Track(
        mode=Mode.TRACKING,
        at=RelativeEstimate(np.zeros(3), np.zeros((3, 3))),
        doubt=np.zeros((3, 3)),
        motion=track.motion,
        missed=0,
        before_lag=None if lag is None else lag.seen_from(at),
        alternative=None if alternative is None else alternative.seen_from(at),
        keyframes=keyframes,
        reference=_reference_of(keyframes, scans, settings),
    )


def _reference_of(keyframes: tuple[Keyframe, ...], scans: Scans, settings: Settings) -> Reference:
    """The points of keyframes in the frame of the last one."""
    rows = np.array([keyframe.scan for keyframe in keyframes])
    path = np.stack([keyframe.pose for keyframe in keyframes])
    return reference_of(scans, rows, path, path[-1], settings.scans_of_reference)


def _alternative_of(
    track: Track, begin: RelativeEstimate, raw: Steps, fit: "_RawMatch"
) -> RelativeEstimate | None:
    """The other pose that the next step of raw odometry may begin at.

    | step of raw odometry | match | alternative |
    |---|---|---|
    | jump, but not set anew | any | the jump: the next step may take it back |
    | other | none | none |
    | frozen | accepted | before the first frozen step: the next step may make up for all |
    | contradicted, does not lag | accepted | raw odometry: the match may be wrong |
    | other | accepted | none |
    """
    if raw.jump and not raw.reset:
        return begin.move(raw.logged, raw.cov)
    if not fit.accepted:
        return None
    if raw.frozen:
        return begin if track.alternative is None else track.alternative
    if fit.contradicts_raw and not raw.lags and not raw.jump:
        return fit.guess
    return None


class _RawMatch(NamedTuple):
    """A match with raw odometry as its prior."""

    guess: RelativeEstimate
    """the pose by raw odometry"""
    prior_cov: Float[np.ndarray, "3 3"]
    """covariance of the guess, wider where the wider search counts after a gap"""
    pose: Float[np.ndarray, "3"]
    cov: Float[np.ndarray, "3 3"]
    inliers: float
    residual: float
    quality: float
    accepted: bool
    sure: bool
    """otherwise a match that is accepted is in doubt"""
    refutes_raw: bool = False
    """the match is from a motion like the one before, against a step that is too fast"""

    @property
    def contradicts_raw(self) -> bool:
        """Whether the match is too far from raw odometry for its covariance."""
        return _contradicts(self.pose, RelativeEstimate(self.guess.pose, self.prior_cov))


_NO_MATCH = _RawMatch(
    guess=RelativeEstimate(np.zeros(3), np.zeros((3, 3))),
    prior_cov=np.zeros((3, 3)),
    pose=np.zeros(3),
    cov=np.zeros((3, 3)),
    inliers=0.0,
    residual=0.0,
    quality=0.0,
    accepted=False,
    sure=False,
)


def _best_match(
    track: Track,
    mode: Mode,
    begin: RelativeEstimate,
    predicted: RelativeEstimate,
    raw: Steps,
    points: Points,
    settings: Settings,
) -> _RawMatch:
    """The best match of a scan, from up to three guesses.

    | guess | tried | preferred to the match before if it is accepted and |
    |---|---|---|
    | the prediction | always | |
    | the alternative, moved by the step | the step is known | better |
    | a motion like the one before | the step is odd | better, and it contradicts raw odometry |

    An odd step beyond `_TOO_ODD` is preferred only if it is clearly better than the third guess,
    any other odd step unless it is clearly worse.
    """
    is_blind = mode is Mode.BLIND or bool(raw.lags)
    best = _match_about(track.reference, points, predicted, raw, is_blind, settings)
    if track.alternative is not None and not raw.unknown:
        guess = track.alternative.move(raw.step, raw.cov)
        fit = _match_about(track.reference, points, guess, raw, is_blind, settings)
        if fit.accepted and fit.quality > best.quality:
            best = fit
    if raw.odd:
        cov = raw.cov + reach_cov(STEP_CHANGE * raw.usual_reach)
        guess = begin.move(track.motion, cov)
        fit = _match_about(track.reference, points, guess, raw, True, settings)
        size = np.array([np.hypot(raw.step[0], raw.step[1]), abs(raw.step[2])])
        too_odd = (size > _TOO_ODD * raw.usual_reach).any()
        gain = -_CLEAR_GAIN if too_odd else _CLEAR_GAIN
        better = fit.accepted and fit.quality > best.quality + gain
        if better and _contradicts(fit.pose, best.guess):
            best = fit._replace(refutes_raw=True)
    return best


def _match_about(
    reference: Reference,
    points: Points,
    guess: RelativeEstimate,
    raw: Steps,
    is_blind: bool,
    settings: Settings,
) -> _RawMatch:
    """The match of a scan about a guess, or, if blind, over all poses that are in reach.

    | search | accepted | sure |
    |---|---|---|
    | about the guess | likely | enough points on walls |
    | all in reach | sure; if odometry is frozen, likely | as good as a loop (`_is_sure`) |

    Where the search about the guess puts too few points on walls, all poses in reach are searched
    too; that match counts if it is sure, clearly better, and within reach of the guess.
    """
    prior_cov = guess.cov
    if is_blind:
        fit = match(FAR, reference, points, guess.pose, prior_cov, NO_FLOOR, settings)
        sure = _is_sure(fit)
        accepted = sure or (bool(raw.frozen) and _is_likely(fit))
    else:
        fit = match(NEAR, reference, points, guess.pose, prior_cov, NO_FLOOR, settings)
        if fit.inliers < _MIN_INLIERS:
            bound = reach_cov(raw.reach)
            wide_cov = _INFLATION * prior_cov + bound
            wide = match(FAR, reference, points, guess.pose, wide_cov, NO_FLOOR, settings)
            better = _is_sure(wide) and _quality(wide) > _quality(fit) + _MIN_GAIN
            # Raw odometry may be off by the robot's reach plus 2 σ of its own.
            off, sigma = poses.between(guess.pose, wide.pose), np.sqrt(guess.cov.diagonal())
            near = np.hypot(off[0], off[1]) <= raw.reach[0] + 2 * sigma[:2].max()
            near = near and abs(off[2]) <= raw.reach[1] + 2 * sigma[2]
            if better and near:
                fit = wide
                prior_cov = prior_cov + bound if raw.gap else prior_cov
        accepted = _is_likely(fit)
        sure = fit.inliers >= _MIN_INLIERS
    return _RawMatch(
        guess=guess,
        prior_cov=prior_cov,
        pose=fit.pose,
        cov=fit.cov,
        inliers=fit.inliers,
        residual=fit.residual,
        quality=_quality(fit),
        accepted=accepted,
        sure=sure,
    )


def _quality(fit: ScanMatch) -> float:
    """The share of points on walls, less the share that is passed through."""
    return fit.inliers - fit.through


def _is_likely(fit: ScanMatch) -> bool:
    """Whether raw odometry and a match support each other."""
    return fit.inliers >= _LEAST_INLIERS and fit.through <= _MAX_THROUGH_LIKELY


def _is_sure(fit: ScanMatch) -> bool:
    """Whether a match may be believed without raw odometry: as good as that of a loop."""
    return fit.inliers >= LOOP_INLIERS and fit.through <= _MAX_THROUGH and not fit.ambiguous


def _contradicts(pose: Float[np.ndarray, "3"], guess: RelativeEstimate) -> bool:
    """Whether a match is too far from a guess for the covariance of the guess."""
    off = poses.between(guess.pose, pose)
    return bool(off @ np.linalg.solve(guess.cov, off) > _DOUBT_GATE)


def _doubt_cov(
    prior_cov: Float[np.ndarray, "3 3"], off: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """The covariance p (P + diag(d², d², t²)) that is added to a match that may be wrong.

    d and t are the distance and turn to raw odometry. Not e eᵀ: of a wrong match not even the
    direction of the error is known.

    Args:
        prior_cov: P, of raw odometry.
        off: e, the pose by raw odometry in the frame of the match.
    """
    at_match = end_covariances.propagate(end_covariances.turns(off[2]), prior_cov)
    square = off[0] ** 2 + off[1] ** 2
    return np.asarray(_DOUBT_PROBABILITY * (at_match + np.diag([square, square, off[2] ** 2])))


def place_unmatched(odometry: Odometry, scans: Scans, steps: Steps, settings: Settings) -> None:
    """Match the scans without a match with the keyframes around them, in place.

    The guess is midway between the neighbours with a match, in the order of the scans, its σ half
    of the distance between them. A match that raw odometry contradicts must be as good as that of
    a loop, and is in doubt. The poses of the others do not change.
    """
    keys, path = odometry.keyframe, odometry.poses
    placed = odometry.matched.copy()
    placed[keys] = True
    for scan in np.flatnonzero(~placed & scans.usable):
        if not placed[scan:].any():
            continue  # nothing after it

        # Guess: on the way between the nearest scans with a place. `argmax` is the first True.
        before = scan - 1 - int(np.argmax(placed[:scan][::-1]))
        after = scan + int(np.argmax(placed[scan:]))
        way = poses.between(path[before], path[after])
        middle = poses.compose(path[before], (scan - before) / (after - before) * way)
        prior_cov = steps.cov[scan] + reach_cov(np.array([np.hypot(way[0], way[1]), abs(way[2])]))

        # Reference: half of its keyframes before the scan, half after it.
        next_key, half = int(np.searchsorted(keys, scan)), settings.reference // 2
        base = keys[next_key - 1]
        around = keys[max(next_key - half, 0) : next_key + half]
        around = around[scans.usable[around]]
        if not len(around):
            continue
        reference = reference_of(
            scans, around, path[around], path[base], settings.scans_of_reference
        )

        # Match, and judge.
        guess = poses.between(path[base], middle)
        points = rows_of(scans.points, scan)
        fit = match(FAR, reference, points, guess, prior_cov, NO_FLOOR, settings)
        if fit.inliers < _LATER_INLIERS or fit.through > _MAX_THROUGH or fit.ambiguous:
            continue
        by_raw = RelativeEstimate(odometry.z[scan].copy(), odometry.cov[scan].copy())
        contradicted = _contradicts(fit.pose, by_raw)
        if contradicted and not _is_sure(fit):
            continue

        # Place. The scan is no neighbour of later ones: `placed` stays.
        path[scan] = poses.compose(path[base], fit.pose)
        odometry.z[scan] = fit.pose
        odometry.cov[scan] = odometry.cov_if_right[scan] = fit.cov
        if contradicted:
            odometry.cov[scan] += _doubt_cov(by_raw.cov, poses.between(fit.pose, by_raw.pose))
        odometry.matched[scan], odometry.doubted[scan] = True, contradicted
        odometry.inliers[scan], odometry.residual[scan] = fit.inliers, fit.residual
