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

    The loops a: i → j and b: k → l close a cycle with the odometry i → k and l → j. Its error is
    e = (x_ij)⁻¹ ∘ x_ik ∘ x_kl ∘ x_lj = (x_i ∘ z_a)⁻¹ ∘ g_b ∘ x_j, where g_b = x_k ∘ z_b ∘ x_l⁻¹
    moves what follows the loop b. To first order and for independent parts its covariance is, all
    of it carried to the world's frame, with S the sums along the path,

        A_a + A_b + |S_k - S_i| + Ad(g_b) |S_j - S_l| Ad(g_b)ᵀ,   A = Ad(x ∘ z) cov Ad(x ∘ z)ᵀ.

    They agree if eᵀ Σ⁻¹ e is below the quantile of χ² with three degrees of freedom (Mangelson,
    Dominic, Eustice & Vasudevan 2018, "Pairwise consistent measurement set maximization for robust
    multi-robot map merging", ICRA).

    Args:
        path: by odometry. total: `covariances.along` of it.
        first, second, z, cov: of the loops; the covariance of the end of z.
    """
    limit = chi2_quantile(probability, 3)
    out = np.ones((len(z), len(z)), bool)
    end = poses.compose(path[first], z)
    moved = poses.compose(end, poses.inverse(path[second]))
    at_end, at_moved = poses.adjoint(end), poses.adjoint(moved)
    own = covariances.propagated(at_end, cov)
    for a in range(len(z) - 1):
        b = slice(a + 1, len(z))
        around = poses.compose(moved[b], path[second[a]])
        error = poses.between(end[a], around) @ at_end[a].T
        spread = own[a] + own[b] + _along(total, first[a], first[b])
        spread += covariances.propagated(at_moved[b], _along(total, second[a], second[b]))
        out[a, b] = out[b, a] = _squared(error, spread) < limit
    return out


def _along(total: np.ndarray, one: np.ndarray, others: np.ndarray) -> Float[np.ndarray, "n 3 3"]:
    return np.asarray(total[np.maximum(one, others)] - total[np.minimum(one, others)])


def _squared(
    error: Float[np.ndarray, "n 3"], cov: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n"]:
    """The squares eᵀ Σ⁻¹ e, by cofactors: `np.linalg.solve` takes most of the time otherwise."""
    x, y, t = error.T
    xx, xy, xt, yy, yt, tt = (cov[:, i, j] for i, j in zip(*np.triu_indices(3), strict=True))
    a, b, c = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
    d, e, f = xx * tt - xt * xt, xy * xt - xx * yt, xx * yy - xy * xy
    determinant = xx * a + xy * b + xt * c
    square = a * x * x + d * y * y + f * t * t + 2 * (b * x * y + c * x * t + e * y * t)
    return np.asarray(square / determinant)


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
    joined = np.where(agree, weight[None, :].astype(np.float32), np.float32(0))
    np.fill_diagonal(joined, 0)
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
