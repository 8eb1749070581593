"""Geometric matching of a cluster of points with points of a map, by pairwise distances.

The cluster's frame is arbitrary: that of a scan of a lost robot, or of a part of the map whose
position has drifted. The full joint covariance of both is used, and the alignment is by weighted
least squares.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core.slots import Joint
from jaxslam.core.validation import InvalidField, at_least, in_range, require
from jaxslam.filters.map_management._point_pairs import (
    PointSets,
    equal_lengths,
    extend_pair,
    longest_pairs,
    mahalanobis_of_pairs,
    quarter_turn,
)
from jaxslam.math import _linalg as linalg
from jaxslam.math import se2
from jaxslam.math.stats import chi2_quantile


class _Alignment(NamedTuple):
    """A weighted alignment of M cluster points, some of them paired with map points."""

    pose: Float[Array, "3"]
    """T with map = T ∘ cluster"""
    distance: Float[Array, ""]
    """D² = rᵀ Σ⁻¹ r"""
    distances: Float[Array, "M"]
    """r_iᵀ Σ_ii⁻¹ r_i of the pairs, else 0"""
    regular: Bool[Array, ""]
    """Σ is positive definite, and the pose is determined"""
    residual: Float[Array, "2*M"]
    """r at the pose, to first order"""
    jacobian: Float[Array, "2*M 3"]
    """∂r/∂T"""
    factor: Float[Array, "2*M 2*M"]
    """Cholesky factor of Σ; the identity without a pair"""


def align_points(points: PointSets, slot: Int[Array, "M"]) -> _Alignment:
    """The pose that aligns cluster points with their map points, -1 for none.

    The closed form without weights (as `se2.align`), and from there one step of generalized least
    squares. Further steps would change the linearization point but not the map, and drift along the
    most uncertain directions. For the same reason ∂r/∂θ is evaluated at the map points, (m - t)⊥
    and not (R z)⊥, which differ by the residual: then a rotation of the whole map rotates the pose
    with it, and the residuals do not depend on it.
    """
    paired, target = slot >= 0, points.map[jnp.maximum(slot, 0)]
    weight = jnp.where(paired, 1.0, 0.0).astype(target.dtype)
    total = jnp.maximum(weight.sum(), 1.0)
    centroid = (weight[:, None] * points.cluster).sum(axis=0) / total
    map_centroid = (weight[:, None] * target).sum(axis=0) / total
    z, goal = points.cluster - centroid[None, :], target - map_centroid[None, :]
    dot = (weight[:, None] * z * goal).sum()
    cross = (weight * (z[:, 0] * goal[:, 1] - z[:, 1] * goal[:, 0])).sum()
    start = jnp.concatenate([jnp.zeros(2, z.dtype), se2.polar(jnp.stack([dot, cross]))[1:]])

    r, jacobian, covs, factor, positive = _residuals(points, slot, z, goal, start)
    whitened = linalg.solve_lower(factor, r)
    by_pose = linalg.solve_lower(factor, jacobian)
    step, solvable = linalg.solve_psd(by_pose.T @ by_pose, by_pose.T @ whitened)
    left = r - jacobian @ step
    distances, _ = mahalanobis_of_pairs(left.reshape(-1, 2), covs)
    # About the centroids the numbers are small; the pose is that of the frames themselves.
    centred = start - step
    shift = map_centroid + centred[:2] - se2.rotation(centred[2]) @ centroid
    heading = jnp.arctan2(jnp.sin(centred[2:]), jnp.cos(centred[2:]))
    by_turn = jnp.where(paired[:, None], quarter_turn(target - shift[None, :]), 0.0)
    return _Alignment(
        pose=jnp.concatenate([shift, heading]),
        distance=((whitened - by_pose @ step) ** 2).sum(),
        distances=jnp.where(paired, distances, 0.0),
        regular=positive & solvable,
        residual=left,
        jacobian=jacobian.at[:, 2].set(by_turn.reshape(-1)),
        factor=factor,
    )


def _residuals(
    points: PointSets,
    slot: Int[Array, "M"],
    z: Float[Array, "M 2"],
    goal: Float[Array, "M 2"],
    pose: Float[Array, "3"],
) -> tuple[
    Float[Array, "2*M"],
    Float[Array, "2*M 3"],
    Float[Array, "M 2 2"],
    Float[Array, "2*M 2*M"],
    Bool[Array, ""],
]:
    """The residuals r_i = T z_i - m_i of points z and goals m about their centroids.

    Returns:
        r, ∂r/∂T, Σ_ii of each pair, the factor of Σ, and whether Σ is positive definite. Without a
        pair r is 0 and Σ_ii the identity.
    """
    m, paired, at = slot.shape[0], slot >= 0, jnp.maximum(slot, 0)
    rotation = se2.rotation(pose[2])
    mixed = jnp.einsum("xy,iyjw->ixjw", rotation, points.cross_cov[:, :, at])
    # cov(r) = R Z Rᵀ + P_mm - R Z_m - (R Z_m)ᵀ, axes (i, xy of i, j, xy of j).
    cov = jnp.einsum("xy,iyjw,vw->ixjv", rotation, points.cluster_cov, rotation)
    cov = cov + points.map_cov[at][:, :, at] - mixed - mixed.transpose(2, 3, 0, 1)
    cov = with_unit_blocks(cov, paired)
    factor, positive = linalg.cholesky(linalg.symmetrize(cov.reshape(2 * m, 2 * m)))
    error = jnp.where(paired[:, None], z @ rotation.T + pose[None, :2] - goal, 0.0)
    eye = jnp.broadcast_to(jnp.eye(2, dtype=z.dtype), (m, 2, 2))
    # ∂(R z)/∂θ is R z turned by 90°; at r = 0, R z is the goal less the translation.
    by_turn = quarter_turn(goal - pose[None, :2])[:, :, None]
    jacobian = jnp.where(paired[:, None, None], jnp.concatenate([eye, by_turn], 2), 0.0)
    blocks = cov[jnp.arange(m), :, jnp.arange(m)]
    return error.reshape(-1), jacobian.reshape(2 * m, 3), blocks, factor, positive


def with_unit_blocks(
    cov: Float[Array, "M 2 M 2"], used: Bool[Array, "M"]
) -> Float[Array, "M 2 M 2"]:
    """The covariance with the identity in the rows and columns of absent points."""
    m = used.shape[0]
    both = jnp.broadcast_to(used[:, None, None, None] & used[None, None, :, None], cov.shape)
    return jnp.where(both, cov, jnp.eye(2 * m, dtype=cov.dtype).reshape(m, 2, m, 2))


_BLOCK = 32
"""Candidates that are scored together: more cost memory, in proportion."""

_FINALISTS = 8
"""Hypotheses that are fitted as a whole, besides the best of each pair: the merit of a hypothesis
ignores correlations, so its order is only approximate."""


class GeometricMatch(NamedTuple):
    """The best match of M cluster points with N map points."""

    pose: Float[Array, "3"]
    """T with map = T ∘ cluster, by generalized least squares over the pairs"""
    slot: Int[Array, "M"]
    """the map point of each cluster point, -1 for none"""
    explained: Int[Array, ""]
    """number of pairs that fit jointly"""
    distance: Float[Array, ""]
    """D² of these pairs, χ² of 2·explained - 3 degrees of freedom"""
    runner_up: Int[Array, ""]
    """number of pairs of the second-best hypothesis, which shares fewer than two pairs"""
    exhausted: Bool[Array, ""]
    """more pairs of points agreed than there was room for"""


class _SearchLimits(NamedTuple):
    """The limits of a search; `search_limits` computes them."""

    single: tuple[float, float]
    """χ² of one and of two degrees of freedom"""
    joint: np.ndarray
    """(M + 1,) χ² of 2n - 3 degrees of freedom, for n pairs"""
    pairs: int
    candidates: int


def check_point_map(joint: Joint) -> None:
    """Raise InvalidField unless landmarks are points and the state keeps no earlier poses."""
    if joint.landmarks.shape[1] != 2:
        size = joint.landmarks.shape[1]
        raise InvalidField("joint", f"expected landmarks (x, y), got {size} parameters each")
    if jax.tree.leaves(joint.lin):
        raise InvalidField("joint", "a linearizer that keeps former estimates is not supported")


def check_search(least: int, margin: int, probability: float, pairs: int, candidates: int) -> None:
    """Raise InvalidField on settings of a search that are out of range.

    least is 3 or more, since two points fit too often by chance.
    """
    require("least", least, at_least(3))
    require("margin", margin, at_least(1))
    require("probability", probability, in_range(0.0, 1.0, open=True))
    require("pairs", pairs, at_least(1))
    require("candidates", candidates, at_least(1))


def search_limits(size: int, probability: float, pairs: int, candidates: int) -> _SearchLimits:
    """The limits of a search over M = size cluster points."""
    # n pairs have 2n coordinates, three of which fix the frame.
    joint = [chi2_quantile(probability, max(2 * n - 3, 1)) for n in range(size + 1)]
    single = chi2_quantile(probability, 1), chi2_quantile(probability, 2)
    return _SearchLimits(single, np.asarray(joint), pairs, candidates)


class _Hypotheses(NamedTuple):
    """The hypotheses of P pairs of cluster points times C candidates, with their matches."""

    slot: Int[Array, "P C M"]
    """the map point of each cluster point, -1 for none"""
    explained: Int[Array, "P C"]
    distance: Float[Array, "P C"]
    """Σ d²"""
    exhausted: Bool[Array, "P"]
    """more candidates agreed than C"""


def match_points(points: PointSets, limits: _SearchLimits) -> GeometricMatch:
    """The match with the most cluster points; among equals, that of least D².

    Each of the longest pairs (a, b) of cluster points is compared with all pairs (j, k) of the map:
    with s and r the two distances, (s - r)²/var(s - r) <= χ²(1). Each agreement fixes the frame T,
    in which the rest of the cluster is tested: δ_il = T z_i - m_l, linear in the errors of z_a,
    z_b, z_i, m_j, m_k and m_l, with d² <= χ²(2) and no point twice. The best hypotheses are then
    fitted as a whole, and lose their worst pair until D² <= χ²(2n - 3).

    No hypothesis (explained = 0, slots -1, the identity) where no two distances agree.
    """
    hypotheses = _hypotheses(points, limits)
    # The best of each cluster pair, then the best of all: the best of all alone may be one
    # hypothesis, which each of its pairs leads to.
    merit = _merit(hypotheses.explained, hypotheses.distance)
    # Row p, column c is number p·C + c of the flat array.
    heads = merit.argmax(axis=1) + jnp.arange(merit.shape[0]) * merit.shape[1]
    merit = merit.reshape(-1)
    rest = jax.lax.top_k(merit, min(_FINALISTS, len(merit)))[1]
    finalists = hypotheses.slot.reshape(-1, len(points.cluster))[jnp.concatenate([heads, rest])]
    fits = jax.vmap(lambda slot: _fit_hypothesis(points, slot, limits))(finalists)
    best: GeometricMatch = jax.tree.map(
        lambda leaf: leaf[jnp.argmax(_merit(fits.explained, fits.distance))], fits
    )
    same = ((hypotheses.slot == best.slot[None, None]) & (hypotheses.slot >= 0)).sum(axis=-1)
    runner_up = jnp.where(same < 2, hypotheses.explained, 0).max()
    return best._replace(
        runner_up=runner_up.astype(jnp.int32), exhausted=hypotheses.exhausted.any()
    )


def _hypotheses(points: PointSets, limits: _SearchLimits) -> _Hypotheses:
    """Hypotheses of the longest cluster pairs with the map pairs whose lengths agree best."""
    n = points.map.shape[0]
    room = min(limits.candidates, n * n)

    def of_pair(ends: tuple[Array, Array]) -> _Hypotheses:
        test, agree = equal_lengths(points, *ends, limits.single[0])
        least, best = jax.lax.top_k(-jnp.where(agree, test, jnp.inf).reshape(-1), room)

        def extend(candidate: tuple[Array, Array]) -> tuple[Array, Array, Array]:
            index, test = candidate
            slots = jnp.stack(jnp.unravel_index(index, (n, n)))
            return extend_pair(points, jnp.stack(ends), slots, test, limits.single[1])

        slot, count, distance = jax.lax.map(extend, (best, -least), batch_size=min(_BLOCK, room))
        return _Hypotheses(slot, count, distance, agree.sum() > room)

    hypotheses: _Hypotheses = jax.lax.map(of_pair, longest_pairs(points, limits.pairs))
    return hypotheses


def _merit(count: Int[Array, "*batch"], distance: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The score of a match: the number of pairs first, then the distance, mapped to 0 … 1."""
    # Below 1, so that no distance outweighs a pair.
    return count - distance / (1 + distance)


def _fit_hypothesis(
    points: PointSets, slot: Int[Array, "M"], limits: _SearchLimits
) -> GeometricMatch:
    """The match of one hypothesis: the least-squares frame of the pairs that fit.

    r_i = T z_i - m_i over the pairs, Σ their joint covariance: min rᵀ Σ⁻¹ r over T, to first order
    about the unweighted closed form. The pair of largest r_iᵀ Σ_ii⁻¹ r_i goes until D² <= χ²(2n-3).
    """
    m = points.cluster.shape[0]
    levels = jnp.asarray(limits.joint, points.cluster.dtype)

    # Each pass drops at most one pair, so m - 2 passes reach two pairs.
    def drop(_: int, slot: Array) -> Array:
        alignment = align_points(points, slot)
        count = (slot >= 0).sum()
        over = (alignment.distance > levels[count]) & (count > 2)
        worst = jnp.argmax(alignment.distances)
        return jnp.where(over & (jnp.arange(m) == worst), -1, slot)

    # Two pairs always have one degree of freedom, which the agreement of distances has tested.
    slot = jax.lax.fori_loop(0, max(m - 2, 0), drop, slot)
    alignment = align_points(points, slot)
    count = (slot >= 0).sum()
    ok = (count >= 2) & alignment.regular & (alignment.distance <= levels[count])
    none = jnp.zeros((), jnp.int32)
    return GeometricMatch(
        pose=jnp.where(ok, alignment.pose, 0.0),
        slot=jnp.where(ok, slot, -1),
        explained=jnp.where(ok, count, 0).astype(jnp.int32),
        distance=jnp.where(ok, alignment.distance, 0.0),
        runner_up=none,
        exhausted=jnp.asarray(False),
    )
