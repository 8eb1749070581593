"""Candidates of loops: places that the graph says may be the same, and scans that look alike."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.laser_slam.settings import Settings
from jaxslam.math import numpy_poses as poses

MOST = 2_500
"""Candidates that are matched in a round, and keyframes that are tried, at most: in a log with more
of them loops abound."""
NEAREST = 12
"""Submaps near a keyframe that may be candidates."""
SAME = 15
"""Keyframes between submaps that are taken to be of one place."""


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
    reach: float,
    gap: int,
) -> Int[np.ndarray, "Q 2"]:
    """Pairs (middle of a submap, keyframe) that are near by the path, and not near in the log.

    Of each keyframe those with the nearest `NEAREST` submaps, since each pair of which the
    covariance is computed fills the factor of the graph. Of more than `MOST` keyframes so many are
    tried, spread evenly over the log.
    """
    found = [np.zeros((0, 2), int)]
    tried = np.flatnonzero(usable)
    if len(tried) > MOST:
        tried = tried[np.linspace(0, len(tried) - 1, MOST).astype(int)]
    for keyframe in tried:
        before = middle[middle <= keyframe - gap]
        far = np.hypot(*(path[before, :2] - path[keyframe, :2]).T)
        order = np.argsort(far, kind="stable")[:NEAREST]
        ones = before[order[far[order] < reach]]
        found.append(np.stack([ones, np.full(len(ones), keyframe)], axis=1))
    return np.concatenate(found)


def by_place(
    path: Float[np.ndarray, "N 3"],
    pairs: Int[np.ndarray, "Q 2"],
    cov: Float[np.ndarray, "Q 3 3"],
    tried: set[tuple[int, int, bool]],
    closed: set[tuple[int, int]],
    settings: Settings,
    narrow: tuple[float, float],
    wide: tuple[float, float],
) -> Candidates:
    """The pairs whose ellipse of uncertainty fits into a window, at most some for each keyframe.

    A place is sought where it is within `loop_reach` of the keyframe, by the ellipse of
    `loop_probability`. For each keyframe the nearest submaps come first, and those that follow each
    other in the log count as one place.

    Args:
        cov: of the end of the relative pose of each pair.
        tried: (first, second, wide) of rounds before. closed: (first, second) that matched.
        narrow, wide: windows, [m] and [rad] to either side.
    """
    sigmas = np.sqrt(-2 * np.log(1 - settings.loop_probability))
    z = poses.between(path[pairs[:, 0]], path[pairs[:, 1]])
    position = sigmas * np.sqrt(np.linalg.eigvalsh(cov[:, :2, :2])[:, 1])
    heading = sigmas * np.sqrt(cov[:, 2, 2])
    far = np.hypot(z[:, 0], z[:, 1])
    small = (position < narrow[0]) & (heading < narrow[1])
    fits = (position < wide[0]) & (heading < wide[1]) & (far < settings.loop_reach + position)
    rows = np.flatnonzero(fits)
    rows = rows[np.lexsort((far[rows], pairs[rows, 1]))]
    chosen: list[int] = []
    taken: dict[int, list[int]] = {}
    for first, second in closed:
        taken.setdefault(second, []).append(first)
    for row in rows:
        first, second = (int(one) for one in pairs[row])
        same = taken.setdefault(second, [])
        if len(same) >= settings.candidates or any(abs(first - one) < SAME for one in same):
            continue
        same.append(first)
        if (first, second, not small[row]) not in tried:
            chosen.append(int(row))
    take = np.array(chosen, int)
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
    pairs = []
    for keyframe in np.flatnonzero(usable)[settings.loop_gap :]:
        before = np.flatnonzero(usable[: keyframe - settings.loop_gap + 1])
        score = descriptors[before] @ descriptors[keyframe]
        if len(before) and score.max() > alike:
            nearest = middle[np.abs(middle - before[score.argmax()]).argmin()]
            pairs.append((nearest, keyframe))
    return np.array(pairs, int).reshape(-1, 2)
