"""Candidates of loops: places that may be the same by the graph, and scans that look alike.

Scans are compared by a descriptor that does not change when the robot turns on the spot.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.math import numpy_poses as poses

_RINGS, SECTORS = 12, 60
"""Rings and sectors of the descriptor."""
_LOOKS_AT_ONCE = 256
"""Keyframes compared with all before them at once: 256 x N floats of memory."""
_LEAST_LIKENESS = 0.9
"""Cosine between the descriptors of two scans above which these look alike."""
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
"""Probability of the ellipse that is searched for a place."""
_MIN_SEPARATION = 15
"""Keyframes between submaps below which they count as one place."""


class Candidates(NamedTuple):
    """Pairs of a submap, by the keyframe in its middle, and a keyframe that may be in it."""

    first: Int[np.ndarray, "M"]
    """row of the keyframe in the middle of the submap"""
    second: Int[np.ndarray, "M"]
    """row of the keyframe"""
    z: Float[np.ndarray, "M 3"]
    """expected pose of the second in the frame of the first"""
    wide: Bool[np.ndarray, "M"]
    """whether the wide window is needed"""
    appearance: Bool[np.ndarray, "M"]
    """whether the pair looks alike, rather than being near"""


def descriptors(
    points: Float[np.ndarray, "n B 2"], valid: Bool[np.ndarray, "n B"], *, reach: float = 12.0
) -> Float[np.ndarray, "n D"]:
    """The descriptors of n scans, of length one (zero for a scan without points).

    Points are counted in rings and sectors about the robot. A turn of the robot shifts the sectors
    and leaves the absolute values of the Fourier coefficients along them, up to the size of a
    sector. The table is that of Kim & Kim 2018, "Scan context", IROS, which compares shifts
    instead.

    Args:
        reach: [m] outer border of the rings; points beyond it count in the last.
    """
    far = np.hypot(points[..., 0], points[..., 1])
    turn = np.arctan2(points[..., 1], points[..., 0]) / (2 * np.pi) % 1.0
    # By the root of the distance, so that near rings are narrow: there points are dense.
    ring = np.minimum((_RINGS * np.sqrt(far / reach)).astype(int), _RINGS - 1)
    sector = np.minimum((SECTORS * turn).astype(int), SECTORS - 1)
    table = np.zeros((len(points), _RINGS, SECTORS))
    scan = np.broadcast_to(np.arange(len(points))[:, None], valid.shape)
    np.add.at(table, (scan[valid], ring[valid], sector[valid]), 1.0)
    # Chosen: the root of the counts, the lower half of the coefficients, the mean at half weight.
    coefficients = np.abs(np.fft.rfft(np.sqrt(table), axis=2))[:, :, : SECTORS // 4]
    coefficients[:, :, 0] *= 0.5
    flat = coefficients.reshape(len(points), -1)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.divide(flat, length, out=np.zeros_like(flat), where=length > 0)


def nearby_pairs(
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
    other in the log are one place. If more than `MOST` keyframes are usable, only `MOST` are tried,
    spread evenly over the log.

    Args:
        closed: pairs that matched, whose places count among `most`.
        reach: [m] largest distance of a pair.
        gap: keyframes between the two, at least.
    """
    pairs = []
    closed_places: dict[int, list[int]] = {}
    for first, second in closed:
        closed_places.setdefault(second, []).append(first)
    rows = np.flatnonzero(usable)
    if len(rows) > MOST:
        rows = rows[np.linspace(0, len(rows) - 1, MOST).astype(int)]
    for keyframe in rows.tolist():
        places = closed_places.get(keyframe, [])
        submaps = middle[: np.searchsorted(middle, keyframe - gap, side="right")]
        far = np.hypot(*(path[submaps, :2] - path[keyframe, :2]).T)
        submaps, far = submaps[far < reach], far[far < reach]
        for place in places:
            apart = np.abs(submaps - place) >= _MIN_SEPARATION
            submaps, far = submaps[apart], far[apart]
        for _ in range(len(places), most):
            if not len(submaps):
                break
            nearest = submaps[far.argmin()]
            pairs.append((nearest, keyframe))
            apart = np.abs(submaps - nearest) >= _MIN_SEPARATION
            submaps, far = submaps[apart], far[apart]
    return np.array(pairs, int).reshape(-1, 2)


def by_place(
    path: Float[np.ndarray, "N 3"],
    pairs: Int[np.ndarray, "Q 2"],
    cov: Float[np.ndarray, "Q 3 3"],
    tried: set[tuple[int, int, bool]],
    narrow: tuple[float, float],
    wide: tuple[float, float],
) -> Candidates:
    """The pairs whose ellipse of uncertainty fits into a window, `CANDIDATES` for each keyframe.

    A place is sought where it is within `REACH` of the keyframe, by the ellipse of
    `_PROBABILITY`.

    Args:
        pairs: `nearby_pairs`, of each keyframe the nearest first.
        cov: of the end of the relative pose of each pair.
        tried: (first, second, wide) of rounds before.
        narrow, wide: windows, [m] and [rad] to either side.
    """
    # Radius of an ellipse in two dimensions, in σ: P(χ²₂ <= r²) = 1 - exp(-r²/2).
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
    rows = rows[np.array(new, bool)]
    return Candidates(
        pairs[rows, 0], pairs[rows, 1], z[rows], ~small[rows], np.zeros(len(rows), bool)
    )


def by_appearance(
    descriptors: Float[np.ndarray, "N D"],
    middle: Int[np.ndarray, "S"],
    usable: Bool[np.ndarray, "N"],
    gap: int,
    near: Candidates,
) -> Candidates:
    """The earlier keyframe most like each keyframe, if it is alike, by the nearest submap.

    The pose is assumed to be that of the submap, and searched in the wide window.

    Args:
        gap: keyframes between the two, at least.
        near: candidates by place; their pairs are left out.
    """
    rows = np.flatnonzero(usable)
    looks = descriptors[rows].astype(np.float32)
    pairs = []
    for begin in range(0, len(rows), _LOOKS_AT_ONCE):
        part = slice(begin, begin + _LOOKS_AT_ONCE)
        before = rows[None, : part.stop] <= rows[part, None] - gap
        likeness = np.where(before, looks[part] @ looks[: part.stop].T, -1.0)
        best = likeness.argmax(axis=1)
        for row in np.flatnonzero(likeness.max(axis=1) > _LEAST_LIKENESS):
            nearest = middle[np.abs(middle - rows[best[row]]).argmin()]
            pairs.append((nearest, rows[begin + row]))
    near_pairs = set(zip(near.first.tolist(), near.second.tolist(), strict=True))
    pairs = [pair for pair in pairs if pair not in near_pairs]
    first, second = np.array(pairs, int).reshape(-1, 2).T
    flag = np.ones(len(pairs), bool)
    return Candidates(first, second, np.zeros((len(pairs), 3)), flag, flag)


def thin(candidates: Candidates) -> tuple[Candidates, int]:
    """At most `MOST` of the candidates, spread evenly over the log, and how many are left out."""
    count = len(candidates.first)
    if count <= MOST:
        return candidates, 0
    order = np.argsort(candidates.second, kind="stable")
    rows = order[np.linspace(0, count - 1, MOST).astype(int)]
    return Candidates(*(column[rows] for column in candidates)), count - MOST
