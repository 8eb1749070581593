"""Weighted poses in a known map, the state of Monte-Carlo localization, and their moments.

A start from anywhere, and recovery, draw poses from a `Region`: the places that a robot may be in.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.core._numbers import as_array, is_concrete
from jaxslam.core._record import record
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import change_where
from jaxslam.math.angles import wrap


def weighted_nis(
    nis: Float[Array, "P M"], matched: Bool[Array, "P M"], log_weight: Float[Array, "P"]
) -> Float[Array, "M"]:
    """The weighted mean NIS of each measurement, over the particles that associate it."""
    weight = jnp.where(matched, jnp.exp(log_weight)[:, None], 0.0)
    total = weight.sum(axis=0)
    return (weight * nis).sum(axis=0) / jnp.where(total > 0, total, 1.0)


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
    # Sums of P terms of random rounding, 8 standard deviations; P headings at random leave 1/√P.
    rounding = 8 * len(w) ** 0.5 * float(jnp.finfo(w.dtype).eps)
    cancel = sine**2 + cosine**2 < rounding**2
    heading = pose[best, 2]
    theta = jnp.where(
        cancel, heading, jnp.arctan2(jnp.where(cancel, 0.0, sine), jnp.where(cancel, 1.0, cosine))
    )
    theta = theta + (w * wrap(pose[:, 2] - theta)).sum()
    mean = jnp.concatenate([xy, wrap(theta)[None]])
    d = pose - mean[None]
    d = jnp.concatenate([d[:, :2], wrap(d[:, 2:])], axis=1)
    spread = (w[:, None, None] * d[:, :, None] * d[:, None, :]).sum(axis=0)
    complement = (w * (1 - w)).sum()  # 1 - Σw², without cancelling
    # One particle leaves a few eps of rounding in Σ w = 1.
    several = complement > 8 * jnp.finfo(w.dtype).eps
    factor = (2 - complement) / jnp.where(several, complement, 1.0)
    return mean, jnp.where(several, factor, 1.0) * spread


class Region:
    """A set of places in the plane, each with any heading; a subclass is a record."""

    def draw(self, count: int, key: Array, dtype: DTypeLike) -> Float[Array, "P 3"]:
        """Poses drawn uniformly in it."""
        raise NotImplementedError

    def moments(self, dtype: DTypeLike) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Mean and covariance of a drawn pose."""
        raise NotImplementedError


@record
class Box(Region):
    """A box, rows its lowest and highest (x, y) [m]."""

    ends: ArrayLike

    def draw(self, count: int, key: Array, dtype: DTypeLike) -> Float[Array, "P 3"]:
        low, high = jnp.asarray(self.ends, dtype)[:, None]
        share = jax.random.uniform(key, (count, 3), dtype)
        heading = wrap(2 * math.pi * share[:, 2:])
        return jnp.concatenate([low + (high - low) * share[:, :2], heading], axis=1)

    def moments(self, dtype: DTypeLike) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        low, high = jnp.asarray(self.ends, dtype)
        mean = jnp.concatenate([0.5 * (low + high), jnp.zeros(1, dtype)])
        # A uniform variable has the variance width²/12, the heading (2π)²/12 about 0.
        variance = jnp.concatenate([(high - low) ** 2, jnp.full(1, 4 * math.pi**2, dtype)]) / 12
        return mean, jnp.diag(variance)


def box_ends(value: ArrayLike) -> ArrayLike:
    """The check of a box (2, 2): its lowest and highest (x, y), finite, with an inside."""
    ends = as_array(value)
    numbers = np.asarray(ends) if is_concrete(ends) else None
    is_box = np.shape(ends) == (2, 2)
    if numbers is not None:
        is_box = is_box and bool(np.isfinite(numbers).all() and (numbers[1] > numbers[0]).all())
    if not is_box:
        raise ValueError(f"expected shape (2, 2), its lowest and highest (x, y), got {value!r}")
    return ends


class ParticleEvents(NamedTuple):
    """Events of the particles since the last scan."""

    resampled: Bool[Array, ""]
    injected: Int[Array, ""]
    """particles drawn from the whole region"""
    invalid: Int[Array, ""]
    """particles with a non-finite pose after the motion"""
    capped: Bool[Array, ""]
    """the wanted number of particles was above the capacity"""


class PoseParticles(NamedTuple):
    """P particles; the first `active` are in use, the others have weight zero."""

    pose: Float[Array, "P 3"]
    """finite also where not in use"""
    log_weight: Float[Array, "P"]
    """Σ exp = 1, -inf where not in use"""
    active: Int[Array, ""]
    best: Int[Array, ""]
    """index of the most likely particle"""
    fresh: Bool[Array, ""]
    """the start is not drawn yet"""
    start_cov: Float[Array, "3 3"]
    """covariance of the start while it is not drawn yet, then zero"""
    fast: Float[Array, ""]
    """short-term average of the scans' likelihood, in units of its peak"""
    slow: Float[Array, ""]
    """long-term average of the likelihood; both averages are 0 before the first scan"""
    due: Bool[Array, ""]
    """the particles are to be resampled before the next motion"""
    injection: Float[Array, ""]
    """probability that resampling draws a particle from the whole region"""
    events: ParticleEvents


def no_events() -> ParticleEvents:
    """`ParticleEvents` of a step without any."""
    no, none = jnp.asarray(False), jnp.zeros((), jnp.int32)
    return ParticleEvents(resampled=no, injected=none, invalid=none, capped=no)


def initial_pose_particles(
    pose: Float[Array, "3"],
    start_cov: Float[Array, "3 3"],
    particles: int,
    region: Region | None = None,
) -> PoseParticles:
    """The initial state: P copies of the pose, to be drawn from N(pose, start_cov), or from a
    region."""
    kind = pose.dtype
    if region is not None:
        pose, start_cov = region.moments(kind)
    zero, no = jnp.zeros((), kind), jnp.asarray(False)
    return PoseParticles(
        pose=jnp.broadcast_to(pose, (particles, 3)),
        log_weight=jnp.full(particles, -math.log(particles), kind),
        active=jnp.asarray(particles, jnp.int32),
        best=jnp.zeros((), jnp.int32),
        fresh=jnp.asarray(True),
        start_cov=start_cov,
        fast=zero,
        slow=zero,
        due=no,
        injection=zero,
        events=no_events(),
    )


def draw_start(state: PoseParticles, key: Array, region: Region | None) -> PoseParticles:
    """The state with its initial poses drawn, if not done before; from a region, where given."""

    def draw(poses: Float[Array, "P 3"]) -> Float[Array, "P 3"]:
        if region is not None:
            return region.draw(len(poses), key, poses.dtype)
        normals = jax.random.normal(key, poses.shape, poses.dtype)
        return jax.vmap(draw_pose, (0, None, 0))(poses, state.start_cov, normals)

    return state._replace(
        pose=change_where(state.fresh, draw, state.pose),
        start_cov=jnp.zeros_like(state.start_cov),
        fresh=jnp.asarray(False),
    )


def active_mask(state: PoseParticles) -> Bool[Array, "P"]:
    """Mask of the particles in use."""
    return jnp.arange(state.pose.shape[0], dtype=state.active.dtype) < state.active


def pose_particle_moments(
    state: PoseParticles,
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Mean and covariance of the pose: `weighted_pose_moments`, or those of the undrawn start."""
    mean, spread = weighted_pose_moments(state.pose, state.log_weight, state.best)
    return mean, spread + state.start_cov


def draw_pose(
    pose: Float[Array, "3"], cov: Float[Array, "3 3"], normal: Float[Array, "3"]
) -> Float[Array, "3"]:
    """A pose drawn from N(pose, cov) with given standard normals; cov may be singular or zero."""
    at = pose + (linalg.cholesky(cov)[0] * normal[None]).sum(axis=1)
    return jnp.concatenate([at[:2], wrap(at[2:])])
