"""Which loops agree: pairwise consistency and a large clique of it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.math import _linalg as linalg
from jaxslam.math import numpy_poses as poses
from jaxslam.math import se2
from jaxslam.math._arrays import float64
from jaxslam.math.stats import chi2_quantile

_TILE = 256
"""Loops that are compared with as many others at once, so that any number shares one program."""

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
        path: by odometry. total: `end_covariances.along` of it.
        first, second, z, cov: of the loops; the covariance of the end of z.
    """
    limit = chi2_quantile(probability, 3)
    count = len(z)
    out = np.zeros((count, count), bool)
    end = poses.compose(path[first], z)
    moved = poses.compose(end, poses.inverse(path[second]))
    loop_cov = end_covariances.propagated(poses.adjoint(end), cov)
    parts = path[second], end, moved, loop_cov, total[first], total[second], first, second
    with float64():
        tiles = [
            _Loop(*(jnp.asarray(_fill(part[begin : begin + _TILE])) for part in parts))
            for begin in range(0, count, _TILE)
        ]
        for i, a in enumerate(tiles):
            for j, b in enumerate(tiles[i:], i):
                rows, columns = (slice(k * _TILE, min((k + 1) * _TILE, count)) for k in (i, j))
                square = np.asarray(_squared_distances(a, b))
                square = square[: rows.stop - rows.start, : columns.stop - columns.start]
                out[rows, columns] = square < limit
    earlier = np.triu(out, 1)
    return np.asarray(earlier | earlier.T | np.eye(count, dtype=bool))


class _Loop(NamedTuple):
    """The data of loops for their agreement, in the world's frame; see `consistent`."""

    at: Array
    """x_j, by odometry"""
    end: Array
    """x_i ∘ z"""
    moved: Array
    """g"""
    cov: Array
    """A"""
    total_first: Array
    """S_i"""
    total_second: Array
    first: Array
    second: Array


def _fill(part: np.ndarray) -> np.ndarray:
    """A part of the loops, its last one repeated up to the size of a tile."""
    return np.concatenate([part, np.repeat(part[-1:], _TILE - len(part), axis=0)])


@jax.jit
def _squared_distances(a: _Loop, b: _Loop) -> Float[Array, "tile tile"]:
    """eᵀ Σ⁻¹ e of each loop of one tile with each of another, the first of them the earlier; ∞
    where Σ is not positive definite."""
    return jax.vmap(lambda one: jax.vmap(lambda other: _of_pair(one, other))(b))(a)


def _of_pair(a: _Loop, b: _Loop) -> Float[Array, ""]:
    error = se2.adjoint(a.end) @ se2.between(a.end, se2.compose(b.moved, a.at))
    ad = se2.adjoint(b.moved)
    forward = jnp.where(a.first <= b.first, 1.0, -1.0)
    backward = jnp.where(a.second <= b.second, 1.0, -1.0)
    first = forward * (b.total_first - a.total_first)
    second = backward * (b.total_second - a.total_second)
    cov = a.cov + b.cov + first + ad @ second @ ad.T
    white, regular = linalg.whitener(cov)
    return jnp.where(regular, ((white @ error) ** 2).sum(), jnp.inf)


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
    joined = agree.astype(np.float32)
    np.fill_diagonal(joined, 0)
    weight = weight.astype(np.float32)
    best, most = none, -1.0
    for start in np.argsort(-(joined @ weight), kind="stable")[:STARTS]:
        chosen, left = none.copy(), joined[start] > 0
        chosen[start] = True
        inside = joined @ (weight * left)  # weight of those left that each agrees with
        while left.any():
            take = int(np.where(left, inside + 1e-3 * weight, -1.0).argmax())
            chosen[take] = True
            gone = np.flatnonzero(left & ~(joined[take] > 0))
            inside -= weight[gone] @ joined[gone]
            left[gone] = False
        if (sum_of := float(weight[chosen].sum())) > most:
            best, most = chosen, sum_of
    return best
