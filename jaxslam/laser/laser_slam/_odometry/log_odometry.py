"""Laser odometry of a log in pieces side by side, and its matches as the controls of a filter."""

import itertools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxslam.core._record import record
from jaxslam.core.protocols import Motion
from jaxslam.core.validation import InvalidField
from jaxslam.laser.laser_slam._odometry.raw import Steps
from jaxslam.laser.laser_slam._odometry.reference import match, reference_of, rows_of
from jaxslam.laser.laser_slam._odometry.tracking import (
    FAR,
    NEAR,
    NO_FLOOR,
    Odometry,
    match_to_keyframes,
    place_unmatched,
)
from jaxslam.laser.laser_slam._records import Settings, Solved
from jaxslam.laser.laser_slam._scan_points import Scans
from jaxslam.math import numpy_poses as poses
from jaxslam.math import se2
from jaxslam.math._arrays import Control, Pose, ProcessNoise, ProcessNoiseCov

_ENDS = ("x [m]", "y [m]", "θ [rad]")
_ROOTS = ("Lxx [m]", "Lyx [m]", "Lyy [m]", "Lθx [rad]", "Lθy [rad]", "Lθθ [rad]")


@record
class MatchMotion(Motion):
    """The motion model of a relative pose whose covariance is part of the control: pose ∘ z ∘ w.

    u = (z, L): z = (x [m], y [m], θ [rad]) in the robot's frame, and the rows of L, the lower
    triangular root of the covariance of the end of z. w ~ N(0, L Lᵀ), (x [m], y [m], θ [rad]) in
    the frame of the robot after z. `match_controls` makes u of the matches of laser odometry.
    """

    controls = (*_ENDS, *_ROOTS)
    noises = _ENDS

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        return se2.compose(se2.compose(pose, u[:3]), w)

    def noise_cov(self, pose: Pose, u: Control) -> ProcessNoiseCov:
        xx, yx, yy, tx, ty, tt = u[3:]
        zero = jnp.zeros_like(xx)
        rows = [xx, zero, zero], [yx, yy, zero], [tx, ty, tt]
        root = jnp.stack([jnp.stack(row) for row in rows])
        return root @ root.T


def match_controls(of: Odometry | Solved) -> Float[np.ndarray, "N 9"]:
    """The controls (N, 9) of `MatchMotion` along the N keyframes of laser odometry, in NumPy.

    Row n leads to keyframe n, and row 0 has no motion: with the scans of `of.keyframe` they make a
    `Log`. Loops take no part. The filter takes noises of successive rows to be independent; matches
    that share scans are not.

    Args:
        of: a result of `laser_odometry` or `solve`.
    Raises:
        ValueError: on anything else.
    """
    if isinstance(of, Odometry):
        z, cov = of.z[of.keyframe[1:]], of.cov[of.keyframe[1:]]
    elif isinstance(of, Solved):
        steps = of.graph.tables["relative_pose"]
        z, cov = np.asarray(steps.z), np.linalg.inv(np.asarray(steps.information, np.float64))
    else:
        raise InvalidField(
            "of", f"expected Odometry or Solved, got {type(of).__name__}", owner="match_controls"
        )
    controls = np.zeros((len(of.keyframe), 9))
    controls[1:, :3] = z
    # Row by row: xx, yx, yy, tx, ty, tt, as `MatchMotion` reads them.
    row, column = np.tril_indices(3)
    controls[1:, 3:] = np.linalg.cholesky(cov)[:, row, column]
    return controls


PIECE = 400
"""Scans of a piece of a log, at least; chosen: a log of 800 scans fills two cores."""
_MARGIN = 5
"""Scans to either side of the first scan of a piece in which raw odometry is right."""


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
    covariances. Its covariance is (H/(2 σ²) + P⁻¹)⁻¹ + floor², with H the information of the lines
    and 2 the number of beams with a common error.

    If fewer than 0.6 of the points meet a wall, or raw odometry is unusable (a jump, a frozen step,
    a step that lags), all poses are searched that the robot can have reached in that time
    (`Steps.reach`). Such a match counts if it is as good as the match of a loop, no other pose is
    nearly as good, and few beams pass through the reference; about raw odometry also if it is
    better by 0.2 than the match there.

    Where raw odometry was frozen, or a match contradicts it, the next step may make up for that, or
    not: the scan is matched from the match before and from raw odometry before, and the better of
    both counts.

    A scan without a match has the pose of raw odometry, is not a keyframe, and is matched again at
    the end, with the keyframes before and after it, from the path between its neighbours. After
    `LOST_AFTER` such scans in a row the next scan is a keyframe, and only keyframes since then are
    matched with. While raw odometry is frozen, the first scan without a match is such a keyframe,
    but less good matches count too, in doubt. The table in `tracking.step` has all cases.

    A match is in doubt that has few points on walls, or that raw odometry contradicts: it may be of
    another place that looks the same. It stays, and is assumed wrong with probability p = 0.1:
    its covariance is about that of the mixture with raw odometry, C + p (P + diag(d², d², t²)),
    where d is the distance and t the turn from the match to raw odometry. The same term is added to
    the scans after it until the next keyframe.

    A log of twice `PIECE` scans or more is tracked in pieces, side by side on every core. The first
    scan of a piece is a keyframe, and its scans are not matched with keyframes of the previous
    piece.
    """
    count = len(scans.usable)
    borders = _borders(scans, steps)
    # Compile the programs of the pieces first, and in parallel the wider search, which is needed
    # later, if at all: nobody waits for it.
    row, origin = np.zeros(1, int), np.zeros((1, 3))
    reference = reference_of(scans, row, origin, origin[0], settings.scans_of_reference)
    arguments = reference, rows_of(scans.points, 0), origin[0], np.eye(3), NO_FLOOR, settings
    match(NEAR, *arguments)
    wider_search = ThreadPoolExecutor(1)
    wider_search.submit(match, FAR, *arguments)
    wider_search.shutdown(wait=False)
    # From 2: the first scan has no match, and is done at the start.
    progress_count, lock = itertools.count(2), threading.Lock()
    stopped = threading.Event()

    def advance() -> None:
        if stopped.is_set():  # another piece failed, or the user interrupts
            raise InterruptedError
        if progress is not None:
            with lock:
                progress(next(progress_count), count)

    def track_piece(begin: int, end: int) -> Odometry:
        rows = slice(begin, end)
        return match_to_keyframes(rows_of(scans, rows), rows_of(steps, rows), settings, advance)

    # The last scan of a piece is the first of the next.
    ends = [*(borders[1:-1] + 1).tolist(), count]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        pieces = [
            pool.submit(track_piece, begin, end)
            for begin, end in zip(borders.tolist(), ends, strict=False)
        ]
        try:
            for piece in as_completed(pieces):
                piece.result()
        except BaseException:
            stopped.set()
            raise
    odometry = _join([piece.result() for piece in pieces], borders, first)
    place_unmatched(odometry, scans, steps, settings)
    return odometry


def _borders(scans: Scans, steps: Steps) -> Int[np.ndarray, "n"]:
    """The first scan of each piece, and the number of scans.

    A piece begins where raw odometry seems right for some scans.
    """
    count = len(scans.usable)
    odd = ~scans.usable | steps.unknown | steps.lags | steps.gap
    odd = np.convolve(odd, np.ones(2 * _MARGIN + 1), "same") > 0
    borders = [0]
    # The nearest such scan to even parts; a part without any stays with the part before.
    for even in np.linspace(0, count, max(count // PIECE, 1) + 1)[1:-1].astype(int):
        near = np.arange(even - PIECE // 4, even + PIECE // 4)
        near = near[~odd[near]]
        if len(near):
            borders.append(int(near[np.abs(near - even).argmin()]))
    return np.array([*borders, count])


def _join(
    pieces: list[Odometry], borders: Int[np.ndarray, "n"], first: Float[np.ndarray, "3"]
) -> Odometry:
    """The odometry of all scans from pieces; each piece ends where the next begins."""
    parts = []
    for piece, begin in zip(pieces, borders[:-1].tolist(), strict=True):
        path = poses.compose(first, piece.poses)
        first = path[-1]
        part = piece._replace(poses=path, base=piece.base + begin)
        if begin:  # its first row is the last row of the piece before, which matched the scan
            part = Odometry(*(column[1:] for column in part))
        parts.append(part._replace(keyframe=piece.keyframe + begin))
    odometry = Odometry(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return odometry._replace(keyframe=np.unique(odometry.keyframe))
