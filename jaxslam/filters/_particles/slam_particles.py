"""Particles with a map each: the state of FastSLAM and of mapping from known poses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Estimate
from jaxslam.filters._particles.pose_particles import draw_pose, weighted_pose_moments
from jaxslam.math import _linalg as linalg


class SlamParticles(NamedTuple):
    """P weighted paths, each with N independent landmark Gaussians: given a path, landmarks are
    independent, and no joint covariance is needed (Murphy 1999; Montemerlo et al. 2002).

    One particle is the same record without the axis P, and without `best`.
    """

    pose: Float[Array, "*P 3"]
    pose_cov: Float[Array, "*P 3 3"]
    """covariance of the pose not drawn yet: of the start, or of a motion before its scan; zero
    after an update"""
    log_weight: Float[Array, "*P"]
    """Σ exp = 1"""
    landmarks: Float[Array, "*P N L"]
    """zero where dead"""
    covs: Float[Array, "*P N L L"]
    """unit where dead"""
    alive: Bool[Array, "*P N"]
    tag: Int[Array, "*P N"]
    """-1 where dead"""
    best: Int[Array, ""] | None
    """the most likely particle, by its weight before the last resampling; None of one particle"""
    lost: Int[Array, "*P"]
    """new landmarks dropped from full maps since the start, along the particle's ancestry"""
    invalid: Bool[Array, "*P"]
    """the last motion gave a pose that was not finite; it was discarded, and the particle has
    weight zero"""
    life: PyTree = None
    """the memory (P, …) of the filter's `Life`, where it has one"""
    further: PyTree = None
    """(k,) numbers of the robot that the sensor of `Mapping` asks for; None where there are none"""


def initial_slam_particles(
    pose: Float[Array, "3"],
    pose_cov: Float[Array, "3 3"],
    particles: int,
    capacity: int,
    landmark_size: int,
) -> SlamParticles:
    """The initial state: P copies of the robot, not yet drawn, and no landmark."""
    kind, shape = pose.dtype, (particles, capacity)
    return SlamParticles(
        pose=jnp.broadcast_to(pose, (particles, 3)),
        pose_cov=jnp.broadcast_to(pose_cov, (particles, 3, 3)),
        log_weight=jnp.full(particles, -jnp.log(float(particles)), kind),
        landmarks=jnp.zeros((*shape, landmark_size), kind),
        covs=jnp.broadcast_to(jnp.eye(landmark_size, dtype=kind), (*shape, *[landmark_size] * 2)),
        alive=jnp.zeros(shape, bool),
        tag=jnp.full(shape, -1, jnp.int32),
        best=jnp.zeros((), jnp.int32),
        lost=jnp.zeros(particles, jnp.int32),
        invalid=jnp.zeros(particles, bool),
    )


def as_only_particle(particle: SlamParticles) -> SlamParticles:
    """One particle as a state of P = 1 with weight 1."""
    alone: SlamParticles = jax.tree.map(lambda leaf: leaf[None], particle)
    return alone._replace(
        log_weight=jnp.zeros_like(alone.log_weight), best=jnp.zeros((), jnp.int32)
    )


def draw_poses(state: SlamParticles, key: Array) -> Float[Array, "P 3"]:
    """A pose drawn from N(pose_p, P_p) for each particle."""
    normals = jax.random.normal(key, state.pose.shape, state.pose.dtype)
    return jax.vmap(draw_pose)(state.pose, state.pose_cov, normals)


def with_finite_poses(
    state: SlamParticles, pose: Float[Array, "P 3"], cov: Float[Array, "P 3 3"]
) -> SlamParticles:
    """The state with new poses and covariances; where one is not finite, the old pose with weight
    zero."""
    good = jnp.isfinite(pose).all(axis=1) & jnp.isfinite(cov).all(axis=(1, 2))
    return state._replace(
        pose=jnp.where(good[:, None], pose, state.pose),
        pose_cov=jnp.where(good[:, None, None], cov, state.pose_cov),
        log_weight=jnp.where(good, state.log_weight, -jnp.inf),
        invalid=state.invalid | ~good,
    )


class ParticleInfo(NamedTuple):
    """The record `info.extra["particles"]`; None for fields that the filter does not have."""

    ess: Float[Array, "*T"]
    """effective number of particles, 1/Σ w², after the scan and before resampling"""
    resampled: Bool[Array, "*T"]
    """the particles were resampled"""
    underflow: Bool[Array, "*T"]
    """no particle had a weight left, and all were given the same; log_likelihood is then 0, not
    -∞"""
    invalid: Int[Array, "*T"]
    """particles that a motion or a scan left with a pose that is not finite; they keep the pose
    before, and have weight zero"""
    active: Int[Array, "*T"] | None = None
    """particles in use, of a filter that chooses their number"""
    injected: Int[Array, "*T"] | None = None
    """particles drawn from wherever the robot may be before this step's motion, to find a lost
    one"""
    capped: Bool[Array, "*T"] | None = None
    """the wanted number of particles was above the capacity"""
    blocked: Int[Array, "*T"] | None = None
    """particles in use that are off the map or in an occupied cell, of a filter in a grid; they
    have weight zero"""

    def counts(self) -> dict[str, Array]:
        """The counts of a campaign, of the fields that the filter has."""
        names = ("resampled", "underflow", "invalid", "injected", "capped")
        events = {name: getattr(self, name) for name in names}
        return {name: happened for name, happened in events.items() if happened is not None}


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
    is_best = (jnp.arange(state.pose.shape[0], dtype=best.dtype) == best)[:, None]
    same = state.alive & state.alive[best][None] & (named | is_best)
    # A most likely particle of weight zero would cause a division by zero.
    w = jnp.where(same, jnp.exp(state.log_weight)[:, None], 0.0)
    w = jnp.where((w.sum(axis=0) > 0)[None], w, is_best.astype(w.dtype))
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
        # A weight of zero times a number that is not finite would be NaN.
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
