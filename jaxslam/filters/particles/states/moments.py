"""Means and covariances of weighted particles."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.particles.states.slam_state import SlamParticles
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.protocols import Sensor
from jaxslam.types import Estimate


def weighted_nis(
    nis: Float[Array, "P M"], matched: Bool[Array, "P M"], log_weight: Float[Array, "P"]
) -> Float[Array, "M"]:
    """The weighted mean NIS of each measurement, over the particles that associate it."""
    share = jnp.where(matched, jnp.exp(log_weight)[:, None], 0.0)
    whole = share.sum(axis=0)
    return (share * nis).sum(axis=0) / jnp.where(whole > 0, whole, 1.0)


def weighted_pose_moments(
    pose: Float[Array, "P 3"], log_weight: Float[Array, "P"], best: Int[Array, ""]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Mean and covariance of poses x_p with weights Σ w = 1.

    The heading's mean is θ_c + Σ w (θ ⊖ θ_c) with θ_c = atan2(Σ w sin θ, Σ w cos θ), so that
    the wrapped deviations d_p = x_p - mean sum to zero and few distinct poses have a singular cov
    (about θ_c it would have a least eigenvalue of order σ⁶). Then

        cov = (1 + Σw²)/(1 - Σw²) Σ w_p d_p d_pᵀ

    1 - Σw² accounts for differences from the sample mean instead of the true one, and 1 + Σw² for
    the variance of the sample mean of 1/Σw² draws; for independent draws cov is the expected square
    of (truth - mean). Two errors remain. Its inverse is biased: the NEES of n consistent
    independent draws has mean 3 (n - 1)/(n - 5), 5.4 of 10 particles and 3.1 of 100. And copies
    made by resampling are not independent: with few distinct ancestors the spread is too small
    (Bailey, Nieto & Nebot 2006). For one particle cov is zero, which means that the error is
    unknown, not that it is zero.
    """
    w = jnp.exp(log_weight)
    xy = (w[:, None] * pose[:, :2]).sum(axis=0)
    # Headings that cancel have no mean; then the heading of the most likely particle is used.
    sine, cosine = (w * jnp.sin(pose[:, 2])).sum(), (w * jnp.cos(pose[:, 2])).sum()
    cancel = sine**2 + cosine**2 < jnp.finfo(w.dtype).eps ** 2
    own = pose[best, 2]
    theta = jnp.where(
        cancel, own, jnp.arctan2(jnp.where(cancel, 0.0, sine), jnp.where(cancel, 1.0, cosine))
    )
    theta = theta + (w * wrap(pose[:, 2] - theta)).sum()
    mean = jnp.concatenate([xy, wrap(theta)[None]])
    d = pose - mean[None]
    d = jnp.concatenate([d[:, :2], wrap(d[:, 2:])], axis=1)
    spread = (w[:, None, None] * d[:, :, None] * d[:, None, :]).sum(axis=0)
    complement = (w * (1 - w)).sum()  # 1 - Σw², without cancelling
    several = complement > 8 * jnp.finfo(w.dtype).eps
    factor = (2 - complement) / jnp.where(several, complement, 1.0)
    return mean, jnp.where(several, factor, 1.0) * spread


def slam_pose_moments(state: SlamParticles) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Mean and covariance of the pose: `weighted_pose_moments` plus Σ w_p P_p, with P_p the
    covariance not yet drawn."""
    assert state.best is not None, "one particle has no moments: see `as_only_particle`"
    mean, spread = weighted_pose_moments(state.pose, state.log_weight, state.best)
    w = jnp.exp(state.log_weight)
    return mean, spread + (w[:, None, None] * state.pose_cov).sum(axis=0)


def slam_estimate(state: SlamParticles, sensor: Sensor) -> Estimate:
    """The estimate of all particles: the pose of `slam_pose_moments`, and a map by slots.

    The map has the slots of the most likely particle. The point of a slot is the mean over the
    particles that hold the same tag there, by weight, and its covariance the mixture's, Σ w C + Σ w
    d dᵀ. Where tags are unknown, landmarks of different particles cannot be matched, and the point
    is the most likely particle's own, with its covariance given that particle's path.
    """
    pose, pose_cov = slam_pose_moments(state)
    best = state.best
    assert best is not None
    named = (state.tag == state.tag[best][None]) & (state.tag[best] >= 0)[None]
    own = (jnp.arange(state.pose.shape[0]) == best)[:, None]
    same = state.alive & state.alive[best][None] & (named | own)
    # A most likely particle of weight zero would cause a division by zero.
    w = jnp.where(same, jnp.exp(state.log_weight)[:, None], 0.0)
    w = jnp.where((w.sum(axis=0) > 0)[None], w, own.astype(w.dtype))
    w = w / w.sum(axis=0)[None]

    def point(
        landmark: Float[Array, "L"], cov: Float[Array, "L L"]
    ) -> tuple[Float[Array, "2"], Float[Array, "2 2"]]:
        jacobian = jax.jacfwd(sensor.position)(landmark)
        return sensor.position(landmark), linalg.matmul(linalg.matmul(jacobian, cov), jacobian.T)

    points, covs = jax.vmap(jax.vmap(point))(state.landmarks, state.covs)
    alive = state.alive[best]

    # Coordinate by coordinate: XLA processes (P, N) much faster than (P, N, 2, 2).
    def average(values: Float[Array, "P N"]) -> Float[Array, "N"]:
        return jnp.where(w > 0, w * values, 0.0).sum(axis=0)

    def mixture_cov(i: int, j: int) -> Float[Array, "N"]:
        off_i, off_j = points[:, :, i] - mean[None, :, i], points[:, :, j] - mean[None, :, j]
        return average(covs[:, :, i, j] + off_i * off_j)

    mean = jnp.stack([average(points[:, :, 0]), average(points[:, :, 1])], axis=1)
    xx, xy, yy = mixture_cov(0, 0), mixture_cov(0, 1), mixture_cov(1, 1)
    cov = jnp.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    return Estimate(
        pose=pose,
        pose_cov=pose_cov,
        points=jnp.where(alive[:, None], mean, 0.0),
        point_covs=jnp.where(alive[:, None, None], cov, jnp.eye(2, dtype=cov.dtype)[None]),
        alive=alive,
        tag=state.tag[best],
    )
