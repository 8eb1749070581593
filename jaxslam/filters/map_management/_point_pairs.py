"""Hypotheses of a geometric match: a pair of cluster points matched with a pair of map points."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.association._rules import mutual


class PointSets(NamedTuple):
    """M cluster points z and N map points m, with their joint covariance."""

    cluster: Float[Array, "M 2"]
    map: Float[Array, "N 2"]
    cluster_cov: Float[Array, "M 2 M 2"]
    map_cov: Float[Array, "N 2 N 2"]
    cross_cov: Float[Array, "M 2 N 2"]
    """covariance of cluster points with map points"""
    allowed: Bool[Array, "M N"]
    """mask of the candidate map points of each cluster point"""


def longest_pairs(points: PointSets, count: int) -> tuple[Int[Array, "P"], Int[Array, "P"]]:
    """The ends a, b of at most `count` long pairs of cluster points, with few pairs a point.

    A distant spurious point would be an end of all the longest pairs. So each use of a point halves
    the length of its further pairs.
    """
    m = points.cluster.shape[0]
    allowed = points.allowed.any(axis=1)
    delta = points.cluster[:, None] - points.cluster[None, :]
    # The root of zero has no derivative.
    length = jnp.sqrt((delta**2).sum(axis=2) + jnp.finfo(delta.dtype).tiny)
    usable = allowed[:, None] & allowed[None, :] & (jnp.arange(m)[:, None] < jnp.arange(m)[None, :])
    length = jnp.where(usable, length, 0.0)

    def choose(
        carry: tuple[Array, Array], _: None
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        chosen, uses = carry
        worth = jnp.where(chosen, 0.0, length) * 0.5 ** (uses[:, None] + uses[None, :])
        a, b = jnp.unravel_index(jnp.argmax(worth), (m, m))
        return (chosen.at[a, b].set(True), uses.at[a].add(1).at[b].add(1)), (a, b)

    start = jnp.zeros((m, m), bool), jnp.zeros(m, length.dtype)
    count = min(count, max(m * (m - 1) // 2, 1))
    return jax.lax.scan(choose, start, None, length=count)[1]


def equal_lengths(
    points: PointSets, a: Int[Array, ""], b: Int[Array, ""], gate: float
) -> tuple[Float[Array, "N N"], Bool[Array, "N N"]]:
    """The squared distances of the lengths of all map pairs (j, k) from a cluster pair's length.

    With s = |z_b - z_a| and r = |m_k - m_j|: (s - r)²/var(s - r), and the mask of the allowed pairs
    with a determined direction for which it is within the gate.
    """
    eps = jnp.finfo(points.map.dtype).eps
    n = points.map.shape[0]
    j, ends = jnp.arange(n), jnp.stack([a, b])
    s, u = _length_and_direction(points.cluster[b] - points.cluster[a])
    r, v = _length_and_direction(points.map[None, :] - points.map[:, None])
    diagonal = points.map_cov[j, :, j]
    map_covs = difference_covs(diagonal, diagonal, points.map_cov.transpose(0, 2, 1, 3))
    variance = jnp.einsum("jlx,jlxy,jly->jl", v, map_covs, v)
    blocks = points.cluster_cov[ends][:, :, ends]
    cluster_cov = blocks[0, :, 0] + blocks[1, :, 1] - blocks[0, :, 1] - blocks[1, :, 0]
    cross = u @ (points.cross_cov[b] - points.cross_cov[a]).reshape(2, -1)
    cross = cross.reshape(n, 2)
    both = (v * (cross[None, :] - cross[:, None])).sum(axis=2)
    # Lengths between exact points may differ by rounding: a few eps, and a margin.
    variance = variance + u @ cluster_cov @ u - 2 * both + (8 * eps * (s + r)) ** 2
    test = (s - r) ** 2 / jnp.maximum(variance, jnp.finfo(s.dtype).tiny)
    possible = points.allowed[a][:, None] & points.allowed[b][None, :]
    possible = possible & (j[:, None] != j[None, :]) & (a != b)
    # The direction of a pair shorter than its uncertainty, 3 σ of its length, is undetermined.
    directed = (s**2 > 9 * u @ cluster_cov @ u) & (s > 0)
    return test, possible & directed & (variance > 0) & (test <= gate)


def extend_pair(
    points: PointSets,
    ends: Int[Array, "2"],
    slots: Int[Array, "2"],
    test: Float[Array, ""],
    gate: float,
) -> tuple[Int[Array, "M"], Int[Array, ""], Float[Array, ""]]:
    """The map points of all cluster points, if those of the ends a, b are the slots j, k.

    A further cluster point is matched with the map point nearest to T z_i, if T z_i is also the
    nearest to that map point, and d² of δ = T z_i - m is within the gate.

    Args:
        ends, slots: a, b and j, k.
        test: () squared distance of the lengths (`equal_lengths`); infinite where they disagree.
        gate: largest d², χ² of two degrees of freedom.
    Returns:
        The map point (M,) of each cluster point, -1 for none; their number; Σ d² with the test.
    """
    frame = _frame_of_pair(points, ends, slots)
    covs, cross_covs = _moved_covs(points, ends, slots, frame)
    i, m = jnp.arange(len(points.cluster)), jnp.arange(len(points.map))
    error_covs = difference_covs(covs, points.map_cov[m, :, m], cross_covs)
    error = frame.moved[:, None] - points.map[None, :]
    distance, regular = mahalanobis_of_pairs(error, error_covs)
    free = (i != ends[0]) & (i != ends[1])
    left = (m != slots[0]) & (m != slots[1])
    fits = points.allowed & regular & (distance <= gate) & free[:, None] & left[None, :]
    slot = mutual(distance, fits)
    total = jnp.where(slot >= 0, distance[i, jnp.maximum(slot, 0)], 0.0).sum()
    slot = slot.at[ends].set(slots.astype(jnp.int32))
    agreed = jnp.isfinite(test)
    slot = jnp.where(agreed, slot, -1)
    return slot, (slot >= 0).sum(), jnp.where(agreed, test + total, 0.0)


class _PairFrame(NamedTuple):
    """The rigid motion T that carries a cluster pair onto a map pair, midpoint onto midpoint."""

    rotation: Float[Array, "2 2"]
    moved: Float[Array, "M 2"]
    """T z_i"""
    jacobians: Float[Array, "M 2 8"]
    """Jacobians of T z_i, through T, by z_a, z_b, m_j and m_k"""


def _frame_of_pair(points: PointSets, ends: Int[Array, "2"], slots: Int[Array, "2"]) -> _PairFrame:
    """The transformation T that carries cluster points a, b = ends onto map points j, k = slots.

    dθ = v⊥·(δm_k - δm_j)/|m_k - m_j| - v⊥·R(δz_b - δz_a)/|z_b - z_a|, with v the direction of the
    map pair; T z_i moves by it times the arm from the midpoint, turned by 90°.
    """
    (z_a, z_b), (m_j, m_k) = points.cluster[ends], points.map[slots]
    s, u = _length_and_direction(z_b - z_a)
    r, v = _length_and_direction(m_k - m_j)
    c, d = (u * v).sum(), u[0] * v[1] - u[1] * v[0]
    rotation = jnp.stack([jnp.stack([c, -d]), jnp.stack([d, c])])
    arm = (points.cluster - (0.5 * (z_a + z_b))[None, :]) @ rotation.T
    swing = quarter_turn(arm)[:, :, None] * quarter_turn(v)[None, None, :]
    half = 0.5 * jnp.eye(2, dtype=arm.dtype)[None]
    by_map = jnp.stack([half - swing / r, half + swing / r], axis=1)
    by_ends = jnp.stack([-half + swing / s, -half - swing / s], axis=1) @ rotation
    jacobians = jnp.concatenate([by_ends, by_map], axis=1).transpose(0, 2, 1, 3)
    return _PairFrame(
        rotation=rotation,
        moved=arm + (0.5 * (m_j + m_k))[None, :],
        jacobians=jacobians.reshape(len(points.cluster), 2, 8),
    )


def _moved_covs(
    points: PointSets, ends: Int[Array, "2"], slots: Int[Array, "2"], frame: _PairFrame
) -> tuple[Float[Array, "M 2 2"], Float[Array, "M N 2 2"]]:
    """Covariances of T z_i, and of T z_i with the map; the error is G (δz_a, δz_b, δm_j, δm_k) +
    R δz_i."""
    (m, n), g, rotation = points.allowed.shape, frame.jacobians, frame.rotation
    cluster, cross, of_map = points.cluster_cov, points.cross_cov, points.map_cov
    # The covariances of the four points that fix T, from axes (point, xy, point, xy): with one
    # another (8, 8), with each z_i, with the map.
    mixed = cross[ends][:, :, slots].reshape(4, 4)
    top = jnp.concatenate([cluster[ends][:, :, ends].reshape(4, 4), mixed], axis=1)
    low = jnp.concatenate([mixed.T, of_map[slots][:, :, slots].reshape(4, 4)], axis=1)
    base = jnp.concatenate([top, low])
    base_cluster = jnp.concatenate(
        [cluster[ends].reshape(4, m, 2), cross[:, :, slots].reshape(m, 2, 4).transpose(2, 0, 1)]
    )
    base_map = jnp.concatenate([cross[ends].reshape(4, n * 2), of_map[slots].reshape(4, -1)])
    i = jnp.arange(m)
    alone = rotation @ cluster[i, :, i] @ rotation.T
    crossed = g @ base_cluster.transpose(1, 0, 2) @ rotation.T
    covs = g @ base @ g.transpose(0, 2, 1) + alone + crossed + crossed.transpose(0, 2, 1)
    with_map = (g.reshape(2 * m, 8) @ base_map).reshape(m, 2, n, 2)
    with_map = with_map + jnp.einsum("xy,iynw->ixnw", rotation, cross)
    return covs, with_map.transpose(0, 2, 1, 3)


def quarter_turn(points: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Vectors rotated by 90°."""
    return jnp.stack([-points[..., 1], points[..., 0]], axis=-1)


def mahalanobis_of_pairs(
    error: Float[Array, "*batch 2"], cov: Float[Array, "*batch 2 2"]
) -> tuple[Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """The squared distance eᵀ P⁻¹ e in closed form, and whether P is positive definite; else 0."""
    p, q, r = cov[..., 0, 0], cov[..., 1, 1], cov[..., 0, 1]
    det = p * q - r * r
    # 4 eps are the rounding of the determinant, and the covariance is a sum of four.
    positive = (p > 0) & (q > 0) & (det > 16 * jnp.finfo(cov.dtype).eps * p * q)
    x, y = error[..., 0], error[..., 1]
    squared = (q * x * x - 2 * r * x * y + p * y * y) / jnp.where(positive, det, 1.0)
    return jnp.where(positive, squared, 0.0), positive


def difference_covs(
    a: Float[Array, "M 2 2"], b: Float[Array, "N 2 2"], cross: Float[Array, "M N 2 2"]
) -> Float[Array, "M N 2 2"]:
    """The covariances of x_i - y_j for all pairs.

    a: covariances of x. b: covariances of y. cross: covariances of x_i with y_j.
    """
    return a[:, None] + b[None] - cross - cross.transpose(0, 1, 3, 2)


def _length_and_direction(
    delta: Float[Array, "*batch 2"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 2"]]:
    """The length |δ|, positive, and the direction δ/|δ|."""
    length = jnp.sqrt((delta**2).sum(axis=-1) + jnp.finfo(delta.dtype).tiny)
    return length, delta / length[..., None]
