"""Weighted poses in a known map: the state of Monte-Carlo localization."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.particles.states.moments import weighted_pose_moments
from jaxslam.filters.particles.states.region import Region
from jaxslam.filters.particles.states.slam_state import draw_pose
from jaxslam.math.xla import change_where


class ParticleEvents(NamedTuple):
    """Events of the particles since the last scan."""

    resampled: Bool[Array, ""]
    injected: Int[Array, ""]
    """drawn from the whole region"""
    invalid: Int[Array, ""]
    """with a non-finite pose after the motion"""
    capped: Bool[Array, ""]
    """more particles were wanted than there may be"""


class PoseParticles(NamedTuple):
    """P particles, of which the first `active` are in use; the others have weight zero."""

    pose: Float[Array, "P 3"]
    """finite also where not in use"""
    log_weight: Float[Array, "P"]
    """Σ exp = 1, -inf where not in use"""
    active: Int[Array, ""]
    best: Int[Array, ""]
    """the most likely particle"""
    fresh: Bool[Array, ""]
    """nothing was drawn yet"""
    start_cov: Float[Array, "3 3"]
    """of the start while it is not drawn yet, then zero"""
    fast: Float[Array, ""]
    """short-term average of the scans' likelihood, in units of its peak"""
    slow: Float[Array, ""]
    """long-term average of the same; both 0 before the first scan"""
    due: Bool[Array, ""]
    """to be resampled before the next motion"""
    injection: Float[Array, ""]
    """the probability of each particle to be drawn from the whole region then"""
    events: ParticleEvents


def no_events() -> ParticleEvents:
    """The record of no events."""
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

    def drawn(poses: Float[Array, "P 3"]) -> Float[Array, "P 3"]:
        if region is not None:
            return region.draw(len(poses), key, poses.dtype)
        return draw_gaussian_poses(poses, state.start_cov, key)

    return state._replace(
        pose=change_where(state.fresh, drawn, state.pose),
        start_cov=jnp.zeros_like(state.start_cov),
        fresh=jnp.asarray(False),
    )


def active_mask(state: PoseParticles) -> Bool[Array, "P"]:
    """Which particles are in use."""
    return jnp.arange(state.pose.shape[0]) < state.active


def pose_particle_moments(
    state: PoseParticles,
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Mean and covariance of the pose: `weighted_pose_moments`, or those of the undrawn start."""
    mean, spread = weighted_pose_moments(state.pose, state.log_weight, state.best)
    return mean, spread + state.start_cov


def draw_gaussian_poses(
    pose: Float[Array, "P 3"], cov: Float[Array, "3 3"], key: Array
) -> Float[Array, "P 3"]:
    """Poses drawn from N(pose_p, cov); cov may be singular or zero."""
    normals = jax.random.normal(key, pose.shape, pose.dtype)
    return jax.vmap(draw_pose, (0, None, 0))(pose, cov, normals)
