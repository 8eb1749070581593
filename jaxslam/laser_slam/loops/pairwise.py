"""Which loops agree: pairwise consistency and a large clique of it."""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.laser_slam import covariances
from jaxslam.math import numpy_poses as poses
from jaxslam.math.stats import chi2_quantile

STARTS = 10
"""Loops from which a clique is grown."""


def consistent(
    path: Float[np.ndarray, "N 3"],
    total: Float[np.ndarray, "N 3 3"],
    first: Int[np.ndarray, "M"],
    second: Int[np.ndarray, "M"],
    z: Float[np.ndarray, "M 3"],
    cov: Float[np.ndarray, "M 3 3"],
    probability: float,
) -> Bool[np.ndarray, "M M"]:
    """Whether each two loops agree with the odometry between their ends.

    The loops a: i → j and b: k → l close a cycle with the odometry i → k and l → j. Its error
    e = (x_ij)⁻¹ ∘ x_ik ∘ x_kl ∘ x_lj has, to first order and for independent parts, the covariance
    of their sum carried to the end; they agree if eᵀ Σ⁻¹ e is below the quantile of χ² with three
    degrees of freedom (Mangelson, Dominic, Eustice & Vasudevan 2018, "Pairwise consistent
    measurement set maximization for robust multi-robot map merging", ICRA).

    Args:
        path: by odometry. total: `poses.along` of it.
        first, second, z, cov: of the loops; the covariance of the end of z.
    """
    limit = chi2_quantile(probability, 3)
    out = np.ones((len(z), len(z)), bool)
    for a in range(len(z) - 1):
        b = np.arange(a + 1, len(z))
        i, j = np.full(len(b), first[a]), np.full(len(b), second[a])
        there = poses.between(path[i], path[first[b]])
        back = poses.between(path[second[b]], path[j])
        around = poses.compose(poses.compose(there, z[b]), back)
        error = poses.between(np.broadcast_to(z[a], around.shape), around)
        spread = covariances.relative_cov(total, path, i, first[b])
        spread = covariances.composed_cov(spread, z[b], cov[b])
        spread = covariances.composed_cov(
            spread, back, covariances.relative_cov(total, path, second[b], j)
        )
        spread = spread + cov[a]
        square = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[..., None])[..., 0])
        out[a, b] = out[b, a] = square < limit
    return out


def clique(agree: Bool[np.ndarray, "M M"], weight: Float[np.ndarray, "M"]) -> Bool[np.ndarray, "M"]:
    """A large set of loops that all agree with each other, by a greedy search.

    From each of the loops of the most agreement the one is added that agrees with the most of those
    left, until none is left; the heaviest set counts (Pattabiraman et al. 2015, "Fast algorithms
    for the maximum clique problem on massive graphs", Internet Mathematics 11). The largest clique
    may be larger.
    """
    none = np.zeros(len(agree), bool)
    if not len(agree):
        return none
    joined = np.where(agree & ~np.eye(len(agree), dtype=bool), weight[None, :], 0.0)
    best, most = none, -1.0
    for start in np.argsort(-joined.sum(axis=1), kind="stable")[:STARTS]:
        chosen, left = none.copy(), joined[start] > 0
        chosen[start] = True
        inside = joined[:, left].sum(axis=1)  # weight of those left that each agrees with
        while left.any():
            take = int(np.where(left, inside + 1e-3 * weight, -1.0).argmax())
            chosen[take] = True
            gone = left & ~(joined[take] > 0)
            inside -= joined[:, gone].sum(axis=1)
            left &= ~gone
        if (sum_of := float(weight[chosen].sum())) > most:
            best, most = chosen, sum_of
    return best
