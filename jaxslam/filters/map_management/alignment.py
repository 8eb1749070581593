"""Weighted least-squares alignment of a cluster of points with points of a map."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.filters.map_management.point_pairs import (
    PointSets,
    mahalanobis_of_pairs,
    quarter_turned,
)
from jaxslam.math import linalg, se2


class Alignment(NamedTuple):
    """A weighted alignment of M cluster points, of which some have a map point."""

    pose: Float[Array, "3"]
    """T with map = T ∘ cluster"""
    distance: Float[Array, ""]
    """D² = rᵀ Σ⁻¹ r"""
    each: Float[Array, "M"]
    """r_iᵀ Σ_ii⁻¹ r_i of the pairs, else 0"""
    regular: Bool[Array, ""]
    """Σ is positive definite, and the pose is determined"""
    residual: Float[Array, "2*M"]
    """r at the pose, to first order"""
    jacobian: Float[Array, "2*M 3"]
    """∂r/∂T"""
    factor: Float[Array, "2*M 2*M"]
    """Cholesky factor of Σ; the identity where there is no pair"""


class _Residuals(NamedTuple):
    """The residuals r_i = T z_i - m_i about the centroids, their covariance and derivative."""

    error: Float[Array, "2*M"]
    jacobian: Float[Array, "2*M 3"]
    covs: Float[Array, "M 2 2"]
    """of each alone"""
    factor: Float[Array, "2*M 2*M"]
    positive: Bool[Array, ""]


def align_points(points: PointSets, slot: Int[Array, "M"]) -> Alignment:
    """The pose that aligns cluster points with their map points, -1 for none.

    The closed form without weights (as `se2.align`), and from there one step of generalized least
    squares. Further steps would change the linearization point but not the map, and drift along the
    most uncertain directions. For the same reason ∂r/∂θ is evaluated at the map points, (m - t)⊥
    and not (R z)⊥, which differ by the residual: then a rotation of the whole map rotates the pose
    with it, and the residuals do not depend on it.
    """
    there, target = slot >= 0, points.map[jnp.maximum(slot, 0)]
    weight = jnp.where(there, 1.0, 0.0).astype(target.dtype)
    total = jnp.maximum(weight.sum(), 1.0)
    centroid = (weight[:, None] * points.cluster).sum(axis=0) / total
    map_centroid = (weight[:, None] * target).sum(axis=0) / total
    z, goal = points.cluster - centroid[None, :], target - map_centroid[None, :]
    dot = (weight[:, None] * z * goal).sum()
    cross = (weight * (z[:, 0] * goal[:, 1] - z[:, 1] * goal[:, 0])).sum()
    start = jnp.concatenate([jnp.zeros(2, z.dtype), se2.polar(jnp.stack([dot, cross]))[1:]])

    r = _residuals(points, slot, z, goal, start)
    whitened = linalg.solve_lower(r.factor, r.error)
    by_pose = linalg.solve_lower(r.factor, r.jacobian)
    step, solvable = linalg.solve_psd(by_pose.T @ by_pose, by_pose.T @ whitened)
    left = r.error - r.jacobian @ step
    each, _ = mahalanobis_of_pairs(left.reshape(-1, 2), r.covs)
    # About the centroids the numbers are small; the pose is that of the frames themselves.
    centred = start - step
    shift = map_centroid + centred[:2] - se2.rotation(centred[2]) @ centroid
    heading = jnp.arctan2(jnp.sin(centred[2:]), jnp.cos(centred[2:]))
    by_turn = jnp.where(there[:, None], quarter_turned(target - shift[None, :]), 0.0)
    return Alignment(
        pose=jnp.concatenate([shift, heading]),
        distance=((whitened - by_pose @ step) ** 2).sum(),
        each=jnp.where(there, each, 0.0),
        regular=r.positive & solvable,
        residual=left,
        jacobian=r.jacobian.at[:, 2].set(by_turn.reshape(-1)),
        factor=r.factor,
    )


def _residuals(
    points: PointSets,
    slot: Int[Array, "M"],
    z: Float[Array, "M 2"],
    goal: Float[Array, "M 2"],
    pose: Float[Array, "3"],
) -> _Residuals:
    """The residuals of points z and goals about their centroids; 0 and identity without a pair."""
    m, there, at = slot.shape[0], slot >= 0, jnp.maximum(slot, 0)
    rotation = se2.rotation(pose[2])
    mixed = jnp.einsum("xy,iyjw->ixjw", rotation, points.cross_cov[:, :, at])
    cov = jnp.einsum("xy,iyjw,vw->ixjv", rotation, points.cluster_cov, rotation)
    cov = cov + points.map_cov[at][:, :, at] - mixed - mixed.transpose(2, 3, 0, 1)
    cov = with_unit_blocks(cov, there)
    factor, positive = linalg.cholesky(linalg.symmetrize(cov.reshape(2 * m, 2 * m)))
    error = jnp.where(there[:, None], z @ rotation.T + pose[None, :2] - goal, 0.0)
    eye = jnp.broadcast_to(jnp.eye(2, dtype=z.dtype), (m, 2, 2))
    by_turn = quarter_turned(goal - pose[None, :2])[:, :, None]
    jacobian = jnp.where(there[:, None, None], jnp.concatenate([eye, by_turn], 2), 0.0)
    own = cov[jnp.arange(m), :, jnp.arange(m)]
    return _Residuals(error.reshape(-1), jacobian.reshape(2 * m, 3), own, factor, positive)


def with_unit_blocks(
    cov: Float[Array, "M 2 M 2"], there: Bool[Array, "M"]
) -> Float[Array, "M 2 M 2"]:
    """The covariance with the identity in the rows and columns of absent points."""
    m = there.shape[0]
    both = jnp.broadcast_to(there[:, None, None, None] & there[None, None, :, None], cov.shape)
    return jnp.where(both, cov, jnp.eye(2 * m, dtype=cov.dtype).reshape(m, 2, m, 2))
