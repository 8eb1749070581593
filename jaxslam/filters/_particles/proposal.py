"""Proposal distributions of a particle's pose: from the motion, or from motion and scan.

The functions of a `SlamParticles` act on one particle; `FastSlam` vmaps them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxslam.association._rules import prediction_from
from jaxslam.core._numbers import gate_quantile
from jaxslam.core.protocols import Motion, Prediction, Sensor
from jaxslam.core.types import Scan
from jaxslam.filters._particles.particle_map import ParticleMapFilter
from jaxslam.filters._particles.scan_association import (
    ParticleAssociation,
    gate_distance,
    particle_association,
    unmatched_distance,
)
from jaxslam.filters._particles.slam_particles import SlamParticles
from jaxslam.linearize import _first_order as first_order
from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import gaussian_terms, log_density, log_det_of
from jaxslam.math.angles import wrap


def sample_motion(
    motion: Motion, pose: Float[Array, "P 3"], u: Float[Array, "U"], key: Array
) -> Float[Array, "P 3"]:
    """The pose f(x_p, u, w_p) of each particle, w_p drawn from N(0, Q(x_p, u))."""
    normals = jax.random.normal(key, (pose.shape[0], len(motion.noises)), pose.dtype)

    def move(pose: Float[Array, "3"], normal: Float[Array, "W"]) -> Float[Array, "3"]:
        # Q may be singular: a noise may have the variance zero.
        return motion.step(pose, u, linalg.root_psd(motion.noise_cov(pose, u)) @ normal)

    return jax.vmap(move)(pose, normals)


def predict_pose(
    motion: Motion, pose: Float[Array, "3"], cov: Float[Array, "3 3"], u: Float[Array, "U"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """The predicted pose and covariance: f(x, u, 0) and F P Fᵀ + W Q Wᵀ."""
    moved, by_pose, noise = first_order.motion_at(motion, pose, u, pose)
    return moved, linalg.symmetrize(linalg.matmul(linalg.matmul(by_pose, cov), by_pose.T) + noise)


def associate_particle(
    filter: ParticleMapFilter, particle: SlamParticles, scan: Scan
) -> ParticleAssociation:
    """The association of a scan with the map of one particle, before the scan corrects its pose."""
    prediction = _predict_measurements(particle, filter.sensor)
    return particle_association(prediction, scan, filter.associate)


class PoseProposal(NamedTuple):
    """The Gaussian of a particle's pose given motion and scan, and the scan's likelihood."""

    pose: Float[Array, "*P 3"]
    pose_cov: Float[Array, "*P 3 3"]
    log_matched: Float[Array, "*P"]
    """log-likelihood of the measurements matched to a landmark"""
    log_unmatched: Float[Array, "*P"]
    """the terms of the other measurements"""


class ParticleInnovations(NamedTuple):
    """The innovations of one particle before its pose is drawn."""

    positive: Bool[Array, "*P M"]
    """S is positive definite"""
    inside: Bool[Array, "*P M"]
    """d² is within the gate; without a gate, finite"""
    used: Bool[Array, "*P M"]
    """matched, inside, and positive"""
    innovation: Float[Array, "*P M Z"]
    innovation_cov: Float[Array, "*P M Z Z"]
    nis: Float[Array, "*P M"]


def propose_pose(
    filter: ParticleMapFilter,
    particle: SlamParticles,
    association: ParticleAssociation,
    scan: Scan,
) -> tuple[PoseProposal, ParticleInnovations]:
    """The Gaussian of the pose given the scan, and the scan's likelihood marginal over the pose.

    Measurement by measurement, each linearized at the pose corrected by those before (Montemerlo
    et al. 2003, FastSLAM 2.0): with H_x, H_l at the means of pose and landmark, C the landmark's
    covariance,

        S = H_x P H_xᵀ + H_l C H_lᵀ + R(ẑ)    x ← x + P H_xᵀ S⁻¹ ν    P ← P - P H_xᵀ S⁻¹ H_x P
        log w += log N(ν; 0, S)

    whose product is the density of the scan given the path. P = 0 (a pose that is drawn
    already) is not changed, and gives the weights of FastSLAM 1.0. P is not inverted, so it may be
    singular. A measurement outside the gate gets d² = γ of the gate. One without a landmark gets
    the d² of `unmatched_distance` and the determinant of a landmark without error,
    log N = -(d² + log |2πR(z)|)/2, so that a particle with fewer associations is not preferred.
    """
    sensor = filter.sensor
    size_z = len(sensor.measurements)
    gamma = gate_quantile(filter.gate, size_z)
    d2_unmatched = jnp.asarray(unmatched_distance(filter.gate, size_z), particle.pose.dtype)

    def correct_by(
        carry: tuple[Array, Array, Array, Array], row: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array, Array, Array], ParticleInnovations]:
        x, p, log_matched, log_unmatched = carry
        z, landmark, cov, matched, valid = row
        by_pose, by_landmark = first_order.observe_jacobians(sensor, x, landmark)
        z_hat = sensor.observe(x, landmark)
        noise = first_order.predicted_noise(sensor, z_hat, z, matched)
        nu = sensor.residual(z, z_hat)
        hp = linalg.matmul(by_pose, p)
        s = linalg.matmul(hp, by_pose.T) + noise
        # The landmark is integrated out: given the path, its error is independent of the pose's.
        s = linalg.symmetrize(s + linalg.matmul(linalg.matmul(by_landmark, cov), by_landmark.T))
        terms = gaussian_terms(nu, s)
        inside, counted, nis = gate_distance(terms.distance, gamma)
        of_map = matched & terms.positive
        used = of_map & inside
        # With S = L Lᵀ and V = L⁻¹ H_x P: x ← x + Vᵀ L⁻¹ ν, P ← P - Vᵀ V. Without use V = 0.
        v = jnp.where(used, linalg.solve_lower(terms.factor, hp), 0.0)
        x = x + linalg.matmul(jnp.where(used, terms.whitened, 0.0)[None], v)[0]
        x = jnp.concatenate([x[:2], wrap(x[2:])])
        p = p - linalg.gram(v, v)
        log_density_matched = log_density(counted, terms.log_det, size_z)
        # R(z): a measurement that is not matched has no prediction (`predicted_noise`).
        log_det_noise = log_det_of(linalg.cholesky(noise)[0])
        log_density_unmatched = log_density(d2_unmatched, log_det_noise, size_z)
        log_matched = log_matched + jnp.where(of_map, log_density_matched, 0.0)
        log_unmatched = log_unmatched + jnp.where(valid & ~of_map, log_density_unmatched, 0.0)
        return (x, p, log_matched, log_unmatched), ParticleInnovations(
            positive=terms.positive,
            inside=inside,
            used=used,
            innovation=jnp.where(matched, nu, 0.0),
            innovation_cov=jnp.where(matched, s, 0.0),
            nis=jnp.where(matched, nis, 0.0),
        )

    slot, zero = association.slot, jnp.zeros((), particle.pose.dtype)
    rows = scan.z, particle.landmarks[slot], particle.covs[slot], association.matched, scan.valid
    start = particle.pose, particle.pose_cov, zero, zero
    corrected, innovations = jax.lax.scan(correct_by, start, rows)
    return PoseProposal(*corrected), innovations


def _predict_measurements(particle: SlamParticles, sensor: Sensor) -> Prediction:
    """The `Prediction` of one particle's map, with landmarks correlated only through the pose."""

    def linearize_map() -> tuple[Float[Array, "N Z"], Float[Array, "N Z 3"], Float[Array, "N Z Z"]]:
        """The prediction ẑ, H_x and H_l C H_lᵀ of each landmark."""

        def linearize(landmark: Array, cov: Array) -> tuple[Array, Array, Array]:
            by_pose, by_landmark = first_order.observe_jacobians(sensor, particle.pose, landmark)
            landmark_cov = linalg.matmul(linalg.matmul(by_landmark, cov), by_landmark.T)
            return sensor.observe(particle.pose, landmark), by_pose, landmark_cov

        return jax.vmap(linearize)(particle.landmarks, particle.covs)

    def measurements() -> tuple[Float[Array, "N Z"], Float[Array, "N Z Z"]]:
        expected, by_pose, landmark_cov = linearize_map()
        robot = jax.vmap(lambda h: linalg.matmul(linalg.matmul(h, particle.pose_cov), h.T))(by_pose)
        return expected, linalg.symmetrize(robot + landmark_cov)

    def cross() -> Float[Array, "N Z N Z"]:
        _, by_pose, landmark_cov = linearize_map()
        # Landmarks i and j are correlated by the pose: H_i P H_jᵀ, and H_l C H_lᵀ where i = j.
        shared = jnp.einsum("izx,xy,jwy->izjw", by_pose, particle.pose_cov, by_pose)
        j = jnp.arange(particle.alive.shape[0])
        return shared.at[j, :, j, :].add(landmark_cov)

    return prediction_from(sensor, particle.tag, particle.alive, measurements, cross)
