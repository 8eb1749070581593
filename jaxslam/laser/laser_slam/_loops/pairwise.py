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
_TIE = 1e-3
"""Share of a loop's own weight in the choice: of loops that agree with the same, the heavier."""


def pairwise_consistency(
    path: Float[np.ndarray, "N 3"],
    total: Float[np.ndarray, "N 3 3"],
    first: Int[np.ndarray, "M"],
    second: Int[np.ndarray, "M"],
    z: Float[np.ndarray, "M 3"],
    cov: Float[np.ndarray, "M 3 3"],
    probability: float,
) -> Bool[np.ndarray, "M M"]:
    """The mask of the pairs of loops that agree with the odometry between their ends.

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
    agree = np.zeros((count, count), bool)
    end = poses.compose(path[first], z)
    moved = poses.compose(end, poses.inverse(path[second]))
    loop_cov = end_covariances.propagate(poses.adjoint(end), cov)
    parts = path[second], end, moved, loop_cov, total[first], total[second], first, second
    with float64():
        # The last loop is repeated up to the size of a tile.
        fill = -(-count // _TILE) * _TILE - count
        padded = [np.concatenate([part, np.repeat(part[-1:], fill, axis=0)]) for part in parts]
        tiles = [
            _Loop(*(jnp.asarray(part[begin : begin + _TILE]) for part in padded))
            for begin in range(0, count, _TILE)
        ]
        for i, a in enumerate(tiles):
            for j, b in enumerate(tiles[i:], i):
                rows, columns = (slice(k * _TILE, min((k + 1) * _TILE, count)) for k in (i, j))
                square = np.asarray(_squared_distances(a, b))
                square = square[: rows.stop - rows.start, : columns.stop - columns.start]
                agree[rows, columns] = square < limit
    # Tiles are computed above the diagonal only, and a pair of loops once.
    earlier = np.triu(agree, 1)
    return np.asarray(earlier | earlier.T | np.eye(count, dtype=bool))


class _Loop(NamedTuple):
    """The loops of a tile, in the world's frame; symbols as in `pairwise_consistency`."""

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
    """S_j"""
    first: Array
    second: Array


@jax.jit
def _squared_distances(a: _Loop, b: _Loop) -> Float[Array, "tile tile"]:
    """eᵀ Σ⁻¹ e of each loop of tile a with each of tile b; ∞ where Σ is not positive definite."""

    def squared_distance(a: _Loop, b: _Loop) -> Float[Array, ""]:
        error = se2.adjoint(a.end) @ se2.between(a.end, se2.compose(b.moved, a.at))
        ad = se2.adjoint(b.moved)
        # |S_k - S_i| and |S_j - S_l|: S grows along the path.
        forward = jnp.where(a.first <= b.first, 1.0, -1.0)
        backward = jnp.where(a.second <= b.second, 1.0, -1.0)
        first = forward * (b.total_first - a.total_first)
        second = backward * (b.total_second - a.total_second)
        cov = a.cov + b.cov + first + ad @ second @ ad.T
        white, regular = linalg.whitener(cov)
        return jnp.where(regular, ((white @ error) ** 2).sum(), jnp.inf)

    return jax.vmap(lambda row: jax.vmap(lambda column: squared_distance(row, column))(b))(a)


def clique(agree: Bool[np.ndarray, "M M"], weight: Float[np.ndarray, "M"]) -> Bool[np.ndarray, "M"]:
    """The mask of a large set of loops that all agree with each other, by a greedy search.

    Each of the `STARTS` loops with the most agreement begins a set. The loop that agrees with the
    most of the candidates joins it, and candidates that disagree with it leave, until no candidate
    is left. The heaviest set counts (Pattabiraman et al. 2015, "Fast algorithms for the maximum
    clique problem on massive graphs", Internet Mathematics 11). The largest clique may be larger.
    """
    best, most = np.zeros(len(agree), bool), -1.0
    joined = agree.astype(np.float32)
    np.fill_diagonal(joined, 0)
    weight = weight.astype(np.float32)
    for start in np.argsort(-(joined @ weight), kind="stable")[:STARTS]:
        chosen, left = np.zeros(len(agree), bool), joined[start] > 0
        chosen[start] = True
        inside = joined @ (weight * left)  # weight of the candidates that each loop agrees with
        while left.any():
            take = int(np.where(left, inside + _TIE * weight, -1.0).argmax())
            chosen[take] = True
            gone = np.flatnonzero(left & ~(joined[take] > 0))
            inside -= weight[gone] @ joined[gone]
            left[gone] = False
        if (total := float(weight[chosen].sum())) > most:
            best, most = chosen, total
    return best
