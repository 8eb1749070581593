"""Candidates of loops: places that may be the same by the graph, and scans that look alike.

Scans are compared by a descriptor that does not change when the robot turns on the spot.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.laser.laser_slam._records import Settings
from jaxslam.math import numpy_poses as poses

_RINGS, SECTORS = 12, 60


def descriptors(
    points: Float[np.ndarray, "n B 2"], valid: Bool[np.ndarray, "n B"], *, reach: float = 12.0
) -> Float[np.ndarray, "n D"]:
    """The descriptors of n scans, of length one (zero for a scan without points).

    Points are counted in rings and sectors about the robot, and a turn of the robot shifts the
    sectors: the sizes of the Fourier coefficients along them stay, up to the size of a sector. The
    table is that of Kim & Kim 2018, "Scan context", IROS, which compares shifts instead.
    """
    far = np.hypot(points[..., 0], points[..., 1])
    turn = np.arctan2(points[..., 1], points[..., 0]) / (2 * np.pi) % 1.0
    ring = np.minimum((_RINGS * np.sqrt(far / reach)).astype(int), _RINGS - 1)
    sector = np.minimum((SECTORS * turn).astype(int), SECTORS - 1)
    table = np.zeros((len(points), _RINGS, SECTORS))
    which = np.broadcast_to(np.arange(len(points))[:, None], valid.shape)
    np.add.at(table, (which[valid], ring[valid], sector[valid]), 1.0)
    sizes = np.abs(np.fft.rfft(np.sqrt(table), axis=2))[:, :, : SECTORS // 4]
    sizes[:, :, 0] *= 0.5
    flat = sizes.reshape(len(points), -1)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.divide(flat, length, out=np.zeros_like(flat), where=length > 0)


MOST = 2_500
"""Candidates that are matched in a round, and keyframes that are tried, at most: a log with more
of them has more loops than its graph needs."""
PLACES = 12
"""Submaps near a keyframe whose relative pose is examined by odometry, which costs little."""
CANDIDATES = 3
"""Submaps that a keyframe is matched with in a round, at most."""
REACH = 3.0
"""Distance [m] between two places that share walls."""
_PROBABILITY = 0.999
"""Of the search ellipse of a place."""
_MIN_SEPARATION = 15
"""Keyframes between submaps that count as one place."""


class Candidates(NamedTuple):
    """Pairs of a submap, by the keyframe in its middle, and a keyframe; where the latter may be."""

    first: Int[np.ndarray, "M"]
    second: Int[np.ndarray, "M"]
    z: Float[np.ndarray, "M 3"]
    """expected pose of the second in the frame of the first"""
    wide: Bool[np.ndarray, "M"]
    """whether the wide window is needed"""
    appearance: Bool[np.ndarray, "M"]


def near(
    path: Float[np.ndarray, "N 3"],
    middle: Int[np.ndarray, "S"],
    usable: Bool[np.ndarray, "N"],
    closed: set[tuple[int, int]],
    most: int,
    reach: float,
    gap: int,
) -> Int[np.ndarray, "Q 2"]:
    """Pairs (middle of a submap, keyframe) that are near by the path, and not near in the log.

    Of each keyframe those with the nearest submaps, `most` places at most: submaps that follow each
    other in the log are one place, and those of `closed` count. Of more than `MOST` keyframes so
    many are tried, spread evenly over the log.

    closed: pairs that matched.
    """
    pairs = []
    known: dict[int, list[int]] = {}
    for first, second in closed:
        known.setdefault(second, []).append(first)
    tried = np.flatnonzero(usable)
    if len(tried) > MOST:
        tried = tried[np.linspace(0, len(tried) - 1, MOST).astype(int)]
    for keyframe in tried.tolist():
        places = known.get(keyframe, [])
        rest = middle[: np.searchsorted(middle, keyframe - gap, side="right")]
        far = np.hypot(*(path[rest, :2] - path[keyframe, :2]).T)
        rest, far = rest[far < reach], far[far < reach]
        for place in places:
            apart = np.abs(rest - place) >= _MIN_SEPARATION
            rest, far = rest[apart], far[apart]
        for _ in range(len(places), most):
            if not len(rest):
                break
            nearest = rest[far.argmin()]
            pairs.append((nearest, keyframe))
            apart = np.abs(rest - nearest) >= _MIN_SEPARATION
            rest, far = rest[apart], far[apart]
    return np.array(pairs, int).reshape(-1, 2)


def by_place(
    path: Float[np.ndarray, "N 3"],
    pairs: Int[np.ndarray, "Q 2"],
    cov: Float[np.ndarray, "Q 3 3"],
    tried: set[tuple[int, int, bool]],
    settings: Settings,
    narrow: tuple[float, float],
    wide: tuple[float, float],
) -> Candidates:
    """The pairs whose ellipse of uncertainty fits into a window, at most some for each keyframe.

    A place is sought where it is within `REACH` of the keyframe, by the ellipse of
    `_PROBABILITY`.

    Args:
        pairs: `near`, of each keyframe the nearest first.
        cov: of the end of the relative pose of each pair.
        tried: (first, second, wide) of rounds before.
        narrow, wide: windows, [m] and [rad] to either side.
    """
    sigmas = np.sqrt(-2 * np.log(1 - _PROBABILITY))
    z = poses.between(path[pairs[:, 0]], path[pairs[:, 1]])
    position = sigmas * np.sqrt(np.linalg.eigvalsh(cov[:, :2, :2])[:, 1])
    heading = sigmas * np.sqrt(cov[:, 2, 2])
    far = np.hypot(z[:, 0], z[:, 1])
    small = (position < narrow[0]) & (heading < narrow[1])
    fits = (position < wide[0]) & (heading < wide[1]) & (far < REACH + position)
    rows = np.flatnonzero(fits)
    # The first `CANDIDATES` of each keyframe, whose pairs follow each other.
    rank = np.arange(len(rows)) - np.searchsorted(pairs[rows, 1], pairs[rows, 1])
    rows = rows[rank < CANDIDATES]
    new = [(*pairs[row].tolist(), not small[row]) not in tried for row in rows]
    take = rows[np.array(new, bool)]
    return Candidates(
        pairs[take, 0], pairs[take, 1], z[take], ~small[take], np.zeros(len(take), bool)
    )


def thinned(of: Candidates) -> tuple[Candidates, int]:
    """At most `MOST` of the candidates, spread evenly over the log, and how many are left out."""
    count = len(of.first)
    if count <= MOST:
        return of, 0
    kept = np.argsort(of.second, kind="stable")[np.linspace(0, count - 1, MOST).astype(int)]
    return Candidates(*(part[kept] for part in of)), count - MOST


def by_appearance(
    descriptors: Float[np.ndarray, "N D"],
    middle: Int[np.ndarray, "S"],
    usable: Bool[np.ndarray, "N"],
    settings: Settings,
    *,
    alike: float = 0.9,
) -> Int[np.ndarray, "M 2"]:
    """Pairs (keyframe, later keyframe) whose descriptors are most alike, one for each keyframe."""
    rows = np.flatnonzero(usable)
    known = descriptors[rows].astype(np.float32)
    pairs = []
    for begin in range(0, len(rows), 256):
        part = slice(begin, begin + 256)
        before = rows[None, : part.stop] <= rows[part, None] - settings.loop_gap
        score = np.where(before, known[part] @ known[: part.stop].T, -1.0)
        best = score.argmax(axis=1)
        for row in np.flatnonzero(score.max(axis=1) > alike):
            nearest = middle[np.abs(middle - rows[best[row]]).argmin()]
            pairs.append((nearest, rows[begin + row]))
    return np.array(pairs, int).reshape(-1, 2)
