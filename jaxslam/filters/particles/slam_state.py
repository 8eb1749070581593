"""Particles with maps of their own: the state of FastSLAM, and the moments it stands for."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.protocols import Sensor
from jaxslam.types import Estimate

Array = jax.Array


class Particles(NamedTuple):
    """P weighted paths, each with N independent landmark Gaussians: given a path, landmarks are
    independent, and no joint covariance is needed (Murphy 1999; Montemerlo et al. 2002)."""

    pose: Array
    """(P, 3)"""
    pose_cov: Array
    """(P, 3, 3) of the pose, of what was not drawn yet: of the start, or of a motion whose scan is
    still to come; zero after an update"""
    log_weight: Array
    """(P,) Σ exp = 1"""
    landmarks: Array
    """(P, N, L), zero where dead"""
    covs: Array
    """(P, N, L, L), unit where dead"""
    alive: Array
    """(P, N) bool"""
    tag: Array
    """(P, N) int32, -1 where dead"""
    best: Any
    """() int: the most likely particle, by its weight before the last resampling"""
    lost: Array
    """(P,) int: new landmarks that found a particle's map full since the start, along its own
    ancestry"""
    invalid: Array
    """(P,) bool: the last motion left a pose that was not finite; it was left out, and the particle
    has no weight"""
    life: Any = ()
    """the memory (P, …) of the filter's `Life`, where it has one"""


def empty(
    pose: Array, pose_cov: Array, particles: int, capacity: int, landmark_size: int
) -> Particles:
    """P times the same robot, not yet drawn, and no landmark."""
    kind, shape = pose.dtype, (particles, capacity)
    return Particles(
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


def drawn(pose: Array, cov: Array, normal: Array) -> Array:
    """A pose of N(pose, cov) from standard normals; cov may be singular or zero."""
    at = pose + (linalg.cholesky(cov)[0] * normal[None]).sum(axis=1)
    return jnp.concatenate([at[:2], wrap(at[2:])])


def finite(pose: Array) -> Array:
    """Whether a pose (P, 3) is a number in all its entries, (P,)."""
    return jnp.isfinite(pose).all(axis=1)


def over_particles(nis: Array, matched: Array, log_weight: Array) -> Array:
    """Σ w nis / Σ w (M,) over the particles that have a landmark for a place, all (P, M)."""
    share = jnp.where(matched, jnp.exp(log_weight)[:, None], 0.0)
    whole = share.sum(axis=0)
    return (share * nis).sum(axis=0) / jnp.where(whole > 0, whole, 1.0)


def pose_moments(state: Particles) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of the pose: `mean_and_spread`, and Σ w_p P_p more, with P_p
    what was not drawn yet."""
    mean, spread = mean_and_spread(state.pose, state.log_weight, state.best)
    w = jnp.exp(state.log_weight)
    return mean, spread + (w[:, None, None] * state.pose_cov).sum(axis=0)


def mean_and_spread(pose: Array, log_weight: Array, best: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of poses x_p (P, 3) of weights Σ w = 1.

    The heading's mean is that of the circle, atan2(Σ w sin θ, Σ w cos θ), and d_p = x_p - mean has
    its heading wrapped. Then

        cov = (1 + Σw²)/(1 - Σw²) Σ w_p d_p d_pᵀ

    A sample is all that is known: 1 - Σw² because distances are from the sample's own mean, 1 + Σw²
    because that mean is itself one of 1/Σw² draws; of independent draws cov is the expected square
    of (truth - mean). Two things no such factor mends. Its inverse is biased: the NEES of n honest
    independent draws has mean 3 (n - 1)/(n - 5), 5.4 of 10 particles and 3.1 of 100. And copies
    made by resampling are not independent: when all descend from few, the spread is theirs, and too
    small (Bailey, Nieto & Nebot 2006). Of one particle cov is zero, which says that nothing is
    known of the error, not that there is none.
    """
    w = jnp.exp(log_weight)
    xy = (w[:, None] * pose[:, :2]).sum(axis=0)
    # Headings that cancel have no mean; there the one of the most likely particle.
    sine, cosine = (w * jnp.sin(pose[:, 2])).sum(), (w * jnp.cos(pose[:, 2])).sum()
    lost = sine**2 + cosine**2 < jnp.finfo(w.dtype).eps ** 2
    own = pose[best, 2]
    theta = jnp.where(
        lost, own, jnp.arctan2(jnp.where(lost, 0.0, sine), jnp.where(lost, 1.0, cosine))
    )
    mean = jnp.concatenate([xy, wrap(theta)[None]])
    d = pose - mean[None]
    d = jnp.concatenate([d[:, :2], wrap(d[:, 2:])], axis=1)
    spread = (w[:, None, None] * d[:, :, None] * d[:, None, :]).sum(axis=0)
    apart = (w * (1 - w)).sum()  # 1 - Σw², without cancelling
    several = apart > 8 * jnp.finfo(w.dtype).eps
    factor = (2 - apart) / jnp.where(several, apart, 1.0)
    return mean, jnp.where(several, factor, 1.0) * spread


def moments(state: Particles, sensor: Sensor) -> Estimate:
    """What the particles say together: the pose of `pose_moments`, and a map by slots.

    The map has the slots of the most likely particle. The point of a slot is the mean over the
    particles that hold the same tag there, by weight, and its covariance the mixture's, Σ w C + Σ w
    d dᵀ. Where tags are unknown, nothing says that two particles hold the same landmark, and the
    point is the most likely particle's own, its covariance given that particle's path.
    """
    pose, pose_cov = pose_moments(state)
    best = state.best
    named = (state.tag == state.tag[best][None]) & (state.tag[best] >= 0)[None]
    own = (jnp.arange(state.pose.shape[0]) == best)[:, None]
    same = state.alive & state.alive[best][None] & (named | own)
    # A most likely particle without weight would leave nothing to divide by.
    w = jnp.where(same, jnp.exp(state.log_weight)[:, None], 0.0)
    w = jnp.where((w.sum(axis=0) > 0)[None], w, own.astype(w.dtype))
    w = w / w.sum(axis=0)[None]

    def point(landmark: Array, cov: Array) -> tuple[Array, Array]:
        slope = jax.jacfwd(sensor.position)(landmark)
        return sensor.position(landmark), linalg.matmul(linalg.matmul(slope, cov), slope.T)

    points, covs = jax.vmap(jax.vmap(point))(state.landmarks, state.covs)
    alive = state.alive[best]

    # Coordinate by coordinate: XLA goes through (P, N) much faster than through (P, N, 2, 2).
    def weighed(values: Array) -> Array:
        return jnp.where(w > 0, w * values, 0.0).sum(axis=0)

    def spread(i: int, j: int) -> Array:
        off_i, off_j = points[:, :, i] - mean[None, :, i], points[:, :, j] - mean[None, :, j]
        return weighed(covs[:, :, i, j] + off_i * off_j)

    mean = jnp.stack([weighed(points[:, :, 0]), weighed(points[:, :, 1])], axis=1)
    xx, xy, yy = spread(0, 0), spread(0, 1), spread(1, 1)
    cov = jnp.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    return Estimate(
        pose=pose,
        pose_cov=pose_cov,
        points=jnp.where(alive[:, None], mean, 0.0),
        point_covs=jnp.where(alive[:, None, None], cov, jnp.eye(2, dtype=cov.dtype)[None]),
        alive=alive,
        tag=state.tag[best],
    )
