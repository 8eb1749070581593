"""Particles with a map each: the state of FastSLAM and of mapping from known poses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.math import linalg
from jaxslam.math.angles import wrap


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


def draw_pose(
    pose: Float[Array, "3"], cov: Float[Array, "3 3"], normal: Float[Array, "3"]
) -> Float[Array, "3"]:
    """A pose drawn from N(pose, cov) with given standard normals; cov may be singular or zero."""
    at = pose + (linalg.cholesky(cov)[0] * normal[None]).sum(axis=1)
    return jnp.concatenate([at[:2], wrap(at[2:])])


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
