"""FastSLAM 1.0 and 2.0: particles for the robot's path, and a small EKF for each landmark."""

import dataclasses
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import Associate, Differentiable, Life, Motion, Resample, Sensor
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import at_least, in_range, instance_of, one_of, or_none, probability
from jaxslam.filters._particles.landmark_ekf import update_map
from jaxslam.filters._particles.particle_map import ParticleMapFilter
from jaxslam.filters._particles.pose_particles import weighted_nis
from jaxslam.filters._particles.proposal import (
    associate_particle,
    predict_pose,
    propose_pose,
    sample_motion,
)
from jaxslam.filters._particles.scan_association import zero_padding
from jaxslam.filters._particles.slam_particles import (
    ParticleInfo,
    SlamParticles,
    draw_poses,
    initial_slam_particles,
    slam_estimate,
    with_finite_poses,
)
from jaxslam.filters._reporting import has_distance, with_extra
from jaxslam.math._arrays import Number
from jaxslam.resampling._methods import systematic
from jaxslam.resampling._weights import normalize, resampled_where


@record
class FastSlam(ParticleMapFilter):
    """FastSLAM: weighted particles for the posterior of the path, and for each path independent
    landmark Gaussians (exact except for linearization). The state is a
    `SlamParticles`.

    "motion", FastSLAM 1.0 (Montemerlo, Thrun, Koller & Wegbreit 2002, "FastSLAM: A factored
    solution to the simultaneous localization and mapping problem"): poses are drawn from the motion
    with its noise, and weighted by the scan. "measurement", 2.0 (Montemerlo et al. 2003, "FastSLAM
    2.0: An improved particle filtering algorithm …"): the pose is a Gaussian that the motion
    predicts and the scan corrects, measurement by measurement; the pose is drawn from the result.
    The weight is the density of the scan with the pose integrated out,
    which does not depend on the draw. So resampling comes first here, and copies of one particle
    get different poses.

    Resampling happens in steps with ESS = 1/Σ w² below threshold·P. Where all weights underflow,
    all become 1/P and `ParticleInfo.underflow` is set; the log-likelihood, -∞, is then 0, so
    `underflow` must be checked in a sum of log-likelihoods. A particle that a motion or a scan
    leaves without a finite pose keeps its previous pose, with weight zero (`ParticleInfo.invalid`).

    An `Info` reports the measurements of the most likely particle (by its weight before
    resampling), whose slots the estimate has. Innovations are conditional on the path of this
    particle; in 2.0 their covariance includes that of the pose, which is not drawn yet. Only nis is
    the mean over the particles by their weights after the scan: its expectation in a consistent
    filter is dof, E_z Σ_p (w_p N_p(z)/p(z)) d²_p = Σ_p w_p E_{N_p} d²_p, while the nis of the most
    likely particle is biased low by selection. log_likelihood is log Σ w p(scan | particle) given
    all earlier scans, of the measurements that a particle has landmarks for.
    `info.extra["particles"]` is a `ParticleInfo`. Estimates: `slam_estimate`.

    Raises ValueError on a capacity, particles or births below 1, a threshold outside [0, 1], a gate
    not above 0 and below 1, an unknown proposal, an invalid life or resample, or a
    sensor that is a suite, absolute, or whose landmarks turn into points.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    """the models; Jacobians come from `jax.jacfwd`"""
    capacity: int = static(check=at_least(1))
    """landmark slots N of each particle. A new landmark that finds a particle's map full is dropped
    there (`Status.OVERFLOW`, and `SlamParticles.lost` for each particle)"""
    particles: int = static(check=at_least(1))
    """P, at least 1"""
    _: dataclasses.KW_ONLY
    proposal: Literal["motion", "measurement"] = static(
        default="measurement", check=one_of("motion", "measurement")
    )
    """distribution from which poses are drawn"""
    resample: Resample | Differentiable = field(
        default=systematic, check=function_of("log_weights", "key")
    )
    """one of `jaxslam.resampling`. Through `StopGradient` of one, the gradient of
    `Info.log_likelihood` is consistent; through `Soft` it is biased, and more so without either,
    since the effect of resampling is then ignored"""
    threshold: Number = field(default=0.5, check=in_range(0.0, 1.0))
    """ESS below which to resample, as a share of P; 0 never resamples, 1 in every step with unequal
    weights"""
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """the landmark of each measurement; a method other than `Known` decides by each particle's
    map"""
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`."""
    births: int | None = static(default=None, check=or_none(at_least(1)))
    """largest number of new landmarks a scan and particle, the rest `Status.DEFERRED`"""
    life: Life | None = field(default=None, check=or_none(instance_of(Life)))
    """rule that removes landmarks from each particle's map (`jaxslam.life`), e.g. by negative
    evidence: `life.Existence` keeps log-odds (P, N) in `SlamParticles.life`"""
    name = "fastslam"
    chart = Euclidean()

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> SlamParticles:
        size = len(self.sensor.landmark)
        state = initial_slam_particles(pose, pose_cov, self.particles, self.capacity, size)
        if self.life is None:
            return state
        return state._replace(life=jax.vmap(self.life.init)(state.pose, state.landmarks))

    def predict(self, state: SlamParticles, u: Float[Array, "U"], key: Array) -> SlamParticles:
        if self.proposal == "measurement":
            ahead = jax.vmap(partial(predict_pose, self.motion, u=u))
            return with_finite_poses(state, *ahead(state.pose, state.pose_cov))
        key_pending, key_noise = jax.random.split(key)
        state = state._replace(pose=draw_poses(state, key_pending))
        moved = sample_motion(self.motion, state.pose, u, key_noise)
        return with_finite_poses(state, moved, jnp.zeros_like(state.pose_cov))

    def update(self, state: SlamParticles, scan: Scan, key: Array) -> tuple[SlamParticles, Info]:
        scan = zero_padding(scan)
        key_resample, key_draw = jax.random.split(key)
        state = state._replace(best=None)  # a number of the whole state: nothing to map over
        # Associate and propose, each particle by its own map.
        association = jax.vmap(partial(associate_particle, self, scan=scan))(state)
        proposal, innovations = jax.vmap(partial(propose_pose, self, scan=scan))(state, association)
        state = with_finite_poses(state, proposal.pose, proposal.pose_cov)
        # Weigh: w_p ← w_p p(scan | particle), Σ w = 1. Terms of measurements without a landmark
        # compare particles; they are no densities, so the log-likelihood is without them.
        log_matched = state.log_weight + proposal.log_matched
        log_weight, _, some = normalize(log_matched + proposal.log_unmatched)
        log_likelihood = normalize(log_matched)[1]
        nis = weighted_nis(innovations.nis, association.matched, log_weight)
        ess = 1.0 / jnp.exp(2 * log_weight).sum()
        resampled = ess < self.threshold * self.particles
        particles = ParticleInfo(ess, resampled, ~some, invalid=state.invalid.sum())
        # Resample, before the draw, as the weight is marginal over the pose: copies of one particle
        # get different poses. Association and innovations move with their particle.
        (state, association, innovations, weight_before), log_weight = resampled_where(
            resampled,
            (state, association, innovations, log_weight),
            log_weight,
            self.resample,
            key_resample,
        )
        # Draw: from here on a pose is known, and so has no covariance.
        state = state._replace(
            pose=draw_poses(state, key_draw),
            pose_cov=jnp.zeros_like(state.pose_cov),
            log_weight=log_weight,
            invalid=jnp.zeros_like(state.invalid),
        )
        # Correct and initialize the landmarks of each particle.
        state, infos = jax.vmap(partial(update_map, self, scan=scan))(
            state, association, innovations
        )
        # Report the most likely particle; after resampling all weights are equal.
        best = jnp.argmax(weight_before).astype(jnp.int32)
        info: Info = jax.tree.map(lambda leaf: leaf[best], infos)
        info = info._replace(
            nis=jnp.where(has_distance(info.status), nis, 0.0),
            log_likelihood=log_likelihood,
            exhausted=association.exhausted.any(),
        )
        return state._replace(best=best), with_extra(info, "particles", particles)

    def estimate(self, state: SlamParticles) -> Estimate:
        return slam_estimate(state, self.sensor)
