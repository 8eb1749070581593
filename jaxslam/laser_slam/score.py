"""Precision and recall of loop closures against poses of reference."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam.laser_slam.records import LoopOutcome, Loops, Solved
from jaxslam.math import numpy_poses as poses


class ClosureScore(NamedTuple):
    """How many of the loops that were kept are right, and how many places were seen again."""

    precision: float
    """correct / kept; NaN without loops"""
    recall: float
    """share of `revisits` that end a correct loop; NaN without any"""
    kept: int
    correct: int
    revisits: int
    """keyframes near an earlier one, as the reference has it"""


def closure_score(
    solved: Solved,
    reference: ArrayLike,
    *,
    position: float = 0.5,
    heading: float = np.deg2rad(5.0),
    near: float = 1.0,
    turned: float = np.pi / 4,
    gap: int = 20,
) -> ClosureScore:
    """The precision and recall of the loops that were kept.

    A loop is correct if its relative pose differs from that of the reference by less than
    `position` [m] and `heading` [rad]. A keyframe revisits a place if an earlier one, at least
    `gap` keyframes before, is within `near` [m] and `turned` [rad].

    reference: (K, 3) poses of all scans, true or corrected.
    """
    known: Float[np.ndarray, "K 3"] = np.asarray(reference, np.float64)
    loops: Loops = solved.loops
    kept = loops.outcome == LoopOutcome.KEPT
    first, second = loops.first[kept], loops.second[kept]
    off = poses.between(loops.z[kept], poses.between(known[first], known[second]))
    right = (np.hypot(off[:, 0], off[:, 1]) < position) & (np.abs(off[:, 2]) < heading)
    keys = known[solved.keyframe]
    seen = np.zeros(len(keys), bool)
    for k in range(gap, len(keys)):
        before = keys[: k - gap + 1]
        far = np.hypot(*(before[:, :2] - keys[k, :2]).T)
        seen[k] = ((far < near) & (np.abs(poses.wrapped(before[:, 2] - keys[k, 2])) < turned)).any()
    again = solved.keyframe[seen]
    met = np.isin(again, second[right])
    return ClosureScore(
        precision=float(right.mean()) if kept.any() else float("nan"),
        recall=float(met.mean()) if len(again) else float("nan"),
        kept=int(kept.sum()),
        correct=int(right.sum()),
        revisits=len(again),
    )
