"""Scores of a solved graph: precision and recall of its loop closures, NEES of its relations.

A relation is the relative pose of any two scans; its covariance is by the solved graph.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam import graphs
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.laser.laser_slam._assembly import ROOM, relative_covs
from jaxslam.laser.laser_slam._records import LoopOutcome, Loops, Solved
from jaxslam.math import numpy_poses as poses
from jaxslam.math._definite import is_invertible

TOGETHER = 512
"""Pairs of keyframes whose marginals are computed at once. A pair adds a block to the Cholesky
factor, and fill: on 771 keyframes 2,000 random pairs take 9 s at once and 1.5 s by 512, without
compilation."""


def relation_covs(
    solved: Solved, first: ArrayLike, second: ArrayLike
) -> Float[np.ndarray, "R 3 3"]:
    """The covariances of the relative poses z = x_i⁻¹ ∘ x_j of R pairs of scans, by the graph.

    Covariances are of the end of z: of the small pose e with true z = z ∘ e, in the frame of scan j
    [m, m, rad]. With a and b the keyframes of i and j (`Solved.base`), and Ad the adjoint,

        Σ = Ad(z)⁻¹ Σ_i Ad(z)⁻ᵀ + Ad(z_j)⁻¹ Σ_ab Ad(z_j)⁻ᵀ + Σ_j

    where Σ_ab is from the joint marginals of the keyframes, zero if a = b, and Σ_i, Σ_j are the
    covariances of the scans relative to their keyframes (`Solved.z_cov`), taken to be independent
    of each other and of the graph. Zero for a scan and itself.

    Args:
        first, second: (R,) scans i and j, in either order.
    Raises:
        ValueError: on other shapes, and on scans that the result does not have.
    """
    i, j = np.asarray(first), np.asarray(second)
    count = len(solved.poses)
    with refusals_of("relation_covs"):
        for scans in (i, j):
            if scans.ndim != 1 or scans.shape != i.shape or scans.dtype.kind not in "iu":
                raise InvalidField(
                    "first, second",
                    f"expected two rows of whole numbers, got {i.shape} and {j.shape}",
                )
            if len(scans) and not (scans.min() >= 0 and scans.max() < count):
                raise InvalidField(
                    "first, second",
                    f"expected scans from 0 to {count - 1}, got {scans.min()} to {scans.max()}",
                )
    a, b = solved.base[i], solved.base[j]
    between = np.zeros((len(i), 3, 3))
    apart = a != b
    # Each pair of keyframes once: a pair costs fill in the factor.
    pairs, row = np.unique(np.stack([a, b], axis=1)[apart], axis=0, return_inverse=True)
    if len(pairs):
        # No iteration: the graph is at its optimum, and only the factor is needed.
        optimum = graphs.optimize(solved.graph, room=ROOM, iterations=0)
        starts = range(0, len(pairs), TOGETHER)
        parts = [relative_covs(optimum, pairs[k : k + TOGETHER]) for k in starts]
        between[apart] = np.concatenate(parts)[row.reshape(-1)]
    z = poses.between(solved.poses[i], solved.poses[j])
    at_start = end_covariances.move(solved.z_cov[i], z)
    cov = at_start + end_covariances.composed_cov(between, solved.z[j], solved.z_cov[j])
    cov[i == j] = 0.0
    return np.asarray(0.5 * (cov + np.swapaxes(cov, 1, 2)))


def relation_nees(
    solved: Solved, first: ArrayLike, second: ArrayLike, z: ArrayLike
) -> Float[np.ndarray, "R"]:
    """The squared errors eᵀ Σ⁻¹ e of relations by the covariances of the graph.

    e = (x_i⁻¹ ∘ x_j)⁻¹ ∘ z, with z (R, 3) the relations of scans i and j, and Σ of `relation_covs`.
    A relation lies in the 95 % ellipse if its error is at most the quantile of χ² with 3 degrees of
    freedom, 7.81. Errors of the relations themselves are not in Σ. NaN where Σ is not positive
    definite: for a scan and itself.

    Raises ValueError as `relation_covs` does.
    """
    cov = relation_covs(solved, first, second)
    i, j = np.asarray(first), np.asarray(second)
    e = poses.between(poses.between(solved.poses[i], solved.poses[j]), np.asarray(z))
    nees = np.full(len(e), np.nan)
    regular = is_invertible(cov)
    nees[regular] = np.einsum(
        "ri,ri->r", e[regular], np.linalg.solve(cov[regular], e[regular][..., None])[..., 0]
    )
    return nees


class ClosureScore(NamedTuple):
    """The precision and recall of the loops that were kept."""

    precision: float
    """correct / kept; NaN without loops"""
    recall: float
    """share of `revisits` that end a correct loop; NaN without any"""
    kept: int
    correct: int
    revisits: int
    """keyframes near an earlier one by the reference path"""


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
    truth: Float[np.ndarray, "K 3"] = np.asarray(reference, np.float64)
    loops: Loops = solved.loops
    kept = loops.outcome == LoopOutcome.KEPT
    first, second = loops.first[kept], loops.second[kept]
    off = poses.between(loops.z[kept], poses.between(truth[first], truth[second]))
    right = (np.hypot(off[:, 0], off[:, 1]) < position) & (np.abs(off[:, 2]) < heading)
    keys = truth[solved.keyframe]
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
