"""Monte-Carlo localization in a known map, including global localization."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from jaxslam.association._rules import Known, prediction_from
from jaxslam.core._numbers import gate_quantile
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import Associate, Motion, Prediction, Sensor
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import InvalidField, at_least, or_none, probability
from jaxslam.filters._known_map import hold_map, map_tags
from jaxslam.filters._particles.pose_particles import Box, PoseParticles, draw_start, weighted_nis
from jaxslam.filters._particles.pose_steps import MonteCarloFilter
from jaxslam.filters._particles.scan_association import (
    gate_distance,
    particle_association,
    unmatched_distance,
    zero_padding,
)
from jaxslam.filters._reporting import info_of, status_of, with_extra
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import gaussian_terms, log_density, log_det_of
from jaxslam.resampling._weights import normalize
from jaxslam.sensors._suite import Suite, split_scan


@record
class ParticleLocalization(MonteCarloFilter):
    """Monte-Carlo localization with an adaptive number of particles, and recovery when lost.

    Poses are drawn from the motion with its noise and weighted by the scan, p(z | x, map), the map
    being without error (Dellaert, Fox, Burgard & Thrun 1999; Thrun, Burgard & Fox, "Probabilistic
    Robotics", table 8.2). The state is a `PoseParticles`. Particles are resampled before a motion,
    if the last scan left ESS = 1/Σ w² below threshold · (particles in use). The number of particles
    in use is then the KLD bound for the bins that they occupy after the motion (Fox 2001;
    `resampling.kld_bound`), at most `particles`; the others have weight zero. In
    `info.extra["particles"]`, a `ParticleInfo`, see `active` and `capped`.

    A kidnapped robot is found again by particles from the whole box (table 8.3). With c the
    weighted average over the particles of exp(-Σ d²/2m) over the m measurements of a scan,

        slow ← slow + α_slow (c - slow)     fast ← fast + α_fast (c - fast)

    each particle drawn is from the box with probability max(0, 1 - fast/slow) instead
    (`injected`). c is the table's likelihood in units of its peak and per measurement, so that it
    does not depend on how many landmarks are in view; the first scan sets both averages; scans
    without a measurement change nothing.

    The estimate has the moments of the weighted particles after a scan, before resampling:
    `weighted_pose_moments`, a single mean and covariance even if the particles form several modes.
    Where all weights underflow, the weights of the particles in use become equal (`underflow`). A
    motion that leaves a non-finite pose is undone, and the particle gets weight zero (`invalid`).
    An `Info` reports the measurements of the most likely particle; nis is the mean over the
    particles by weight, as in `FastSlam`; log_likelihood is log Σ w p(scan | x) of the measurements
    matched to a landmark.

    Shapes are fixed, so the cost of a step depends on the capacity, not on the particles in use.

    With a precise sensor no particle may lie within its noise (particle deprivation), and all may
    converge to a wrong position. Then take more particles, or inflate the sensor noise, as is
    customary; the estimate is then conservative.

    Raises ValueError as `MonteCarloFilter`, on a map or tags as `Localization` refuses them, or a
    gate not above 0 and below 1.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    """any sensor; in a `sensors.Suite`, absolute sensors enter the weights too"""
    landmarks: ArrayLike
    """(N, L) the map, in the sensor's parameters"""
    particles: int = static(check=at_least(1))
    """the capacity P, at least 1"""
    _: dataclasses.KW_ONLY
    tags: tuple[int, ...] | None = static(default=None)
    """N different tags of the landmarks; default the row numbers"""
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """the landmark of each measurement; a method other than by tag decides for each particle, by
    its pose alone (MaximumLikelihood(None): the most likely landmark)"""
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`; a measurement beyond the gate counts with d² = γ, and is reported as
    rejected"""

    def __post_init__(self) -> None:
        hold_map(self)
        if self.start == "uniform" and self.box is None:
            raise InvalidField("box", "expected one with a uniform start, got None")
        super().__post_init__()

    @property
    def map_size(self) -> int | None:  # type: ignore[override]
        is_whole = self.tags is None and self.sensor.landmark
        return np.shape(self.landmarks)[0] if is_whole else None

    @property
    def region(self) -> Box | None:
        return None if self.box is None else Box(self.box)

    def update(self, state: PoseParticles, scan: Scan, key: Array) -> tuple[PoseParticles, Info]:
        scan = zero_padding(scan)
        state = draw_start(state, key, self._start_region)
        likelihood = jax.vmap(partial(scan_likelihood, self, scan=scan))(state.pose)
        log_likelihood = normalize(state.log_weight + likelihood.log_density.sum(axis=1))[1]
        misfit = 0.5 * (likelihood.counted + likelihood.spread).sum(axis=1)
        # Recovery compares scans, and so leaves out how large their noise is.
        fit = 0.5 * likelihood.counted.sum(axis=1)
        measured = likelihood.measured[0].sum()
        state, particles = self.weigh(state, misfit, fit, measured)
        info = _report(scan, likelihood, state.log_weight, log_likelihood)
        return state, with_extra(info, "particles", particles)

    def estimate(self, state: PoseParticles) -> Estimate:
        points = jnp.asarray(self.landmarks, state.pose.dtype)
        return self.pose_estimate(state, jax.vmap(self.sensor.position)(points), map_tags(self))


class ScanLikelihood(NamedTuple):
    """The likelihood of a scan at one pose, for each measurement.

    Pose and map have no error here, so the covariance of an innovation is the sensor's noise R(ẑ),
    which differs between poses.
    """

    measured: Bool[Array, "*P M"]
    """mask of the measurements that enter the likelihood"""
    slot: Int[Array, "*P M"]
    """slot of the measured landmark; -1 of an absolute sensor"""
    matched: Bool[Array, "*P M"]
    positive: Bool[Array, "*P M"]
    """R(ẑ) is positive definite"""
    inside: Bool[Array, "*P M"]
    """d² is within the gate; without a gate, finite"""
    innovation: Float[Array, "*P M Z"]
    innovation_cov: Float[Array, "*P M Z Z"]
    """R(ẑ)"""
    nis: Float[Array, "*P M"]
    """d² = νᵀ R(ẑ)⁻¹ ν"""
    dof: Int[Array, "*P M"]
    """Z of the sensor"""
    counted: Float[Array, "*P M"]
    """d² in the weight: at most γ of the gate, `unmatched_distance` without a landmark, 0 where
    there is no measurement"""
    spread: Float[Array, "*P M"]
    """log |R(ẑ)| - log |R(z)| of measurements matched to a landmark, else 0; log |R(z)| is the same
    at all poses"""
    log_density: Float[Array, "*P M"]
    """-(counted + log |2πR(ẑ)|)/2 of measurements matched to a landmark, else 0"""
    exhausted: Bool[Array, "*P"]
    """the association's search ended at its budget"""


def scan_likelihood(
    filter: ParticleLocalization, pose: Float[Array, "3"], scan: Scan
) -> ScanLikelihood:
    """The likelihood of a scan of all sensors at one pose.

    Raises ValueError if the scan does not have the measurement slots of the suite.
    """
    if not isinstance(filter.sensor, Suite):
        return _sensor_likelihood(filter, filter.sensor, pose, scan)
    likelihoods = []
    for part, part_scan in zip(
        filter.sensor.parts, split_scan(scan, filter.sensor.places), strict=True
    ):
        size = len(part.sensor.measurements)
        part_scan = part_scan._replace(z=part_scan.z[:, :size])
        if part.sees == "robots":
            likelihood = _zero_likelihood(pose, part_scan)
        else:
            likelihood = _sensor_likelihood(filter, part.sensor, pose, part_scan)
        pad = 0, scan.z.shape[1] - size
        likelihoods.append(
            likelihood._replace(
                innovation=jnp.pad(likelihood.innovation, [(0, 0), pad]),
                innovation_cov=jnp.pad(likelihood.innovation_cov, [(0, 0), pad, pad]),
                exhausted=likelihood.exhausted[None],
            )
        )
    joined: ScanLikelihood = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *likelihoods)
    return joined._replace(exhausted=joined.exhausted.any())


def _sensor_likelihood(
    filter: ParticleLocalization, sensor: Sensor, pose: Float[Array, "3"], scan: Scan
) -> ScanLikelihood:
    """The likelihood of one sensor's measurements.

    A measurement outside the gate gets d² = γ of the gate, and one without a landmark
    `unmatched_distance`, so that a particle with fewer associations is not preferred. With a gate
    no weight underflows because of a single outlier.
    """
    size_z, size_l = len(sensor.measurements), len(sensor.landmark)
    # In a suite an absolute sensor, whose landmarks have no parameters, shares the others' map.
    landmarks = jnp.asarray(filter.landmarks, pose.dtype)[:, :size_l]
    if sensor.landmark:
        prediction = _predict_measurements(sensor, pose, landmarks, map_tags(filter))
        slot, matched, _, exhausted = particle_association(prediction, scan, filter.associate)
    else:
        slot, matched = jnp.zeros(scan.tag.shape, jnp.int32), scan.valid
        exhausted = jnp.asarray(False)
    z_hat = jax.vmap(sensor.observe, (None, 0))(pose, landmarks[slot])
    noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, scan.z, matched)
    nu = jax.vmap(sensor.residual)(scan.z, z_hat)
    terms = jax.vmap(gaussian_terms)(nu, noise)
    # A measurement without a landmark would count with log |R(z)|, as in `propose_pose`. It is the
    # same at all poses, and is taken out of all weights.
    factor_at_z = jax.vmap(lambda z: linalg.cholesky(sensor.noise_cov(z))[0])(scan.z)
    inside, gated, nis = gate_distance(terms.distance, gate_quantile(filter.gate, size_z))
    of_map = matched & terms.positive
    far = jnp.asarray(unmatched_distance(filter.gate, size_z), scan.z.dtype)
    counted = jnp.where(of_map, gated, jnp.where(scan.valid, far, 0.0))
    density = log_density(counted, terms.log_det, size_z)
    return ScanLikelihood(
        measured=scan.valid,
        slot=slot if sensor.landmark else jnp.full_like(slot, -1),
        matched=matched,
        positive=terms.positive,
        inside=inside,
        innovation=jnp.where(matched[:, None], nu, 0.0),
        innovation_cov=jnp.where(matched[:, None, None], noise, 0.0),
        nis=jnp.where(matched, nis, 0.0),
        dof=jnp.full_like(slot, size_z),
        counted=counted,
        spread=jnp.where(of_map, terms.log_det - jax.vmap(log_det_of)(factor_at_z), 0.0),
        log_density=jnp.where(of_map, density, 0.0),
        exhausted=exhausted,
    )


def _zero_likelihood(pose: Float[Array, "3"], scan: Scan) -> ScanLikelihood:
    """The likelihood of measurements without effect, those of other robots."""
    m, size = scan.z.shape
    zero, none, no = (jnp.zeros(m, dtype) for dtype in (pose.dtype, jnp.int32, bool))
    return ScanLikelihood(
        measured=no,
        slot=none,
        matched=no,
        positive=no,
        inside=no,
        innovation=jnp.zeros((m, size), pose.dtype),
        innovation_cov=jnp.zeros((m, size, size), pose.dtype),
        nis=zero,
        dof=jnp.full_like(none, size),
        counted=zero,
        spread=zero,
        log_density=zero,
        exhausted=jnp.asarray(False),
    )


def _predict_measurements(
    sensor: Sensor,
    pose: Float[Array, "3"],
    landmarks: Float[Array, "N L"],
    tags: Int[Array, "N"],
) -> Prediction:
    """The `Prediction` of a known map from an exact pose: S_ij = R(ẑ_j)."""
    count, size = landmarks.shape[0], len(sensor.measurements)

    def measurements() -> tuple[Float[Array, "N Z"], None]:
        return jax.vmap(sensor.observe, (None, 0))(pose, landmarks), None

    def cross() -> Float[Array, "N Z N Z"]:
        # H P Hᵀ = 0: neither pose nor map has an error, so no two measurements are correlated.
        return jnp.zeros((count, size, count, size), pose.dtype)

    return prediction_from(sensor, tags, jnp.ones(count, bool), measurements, cross)


def _report(
    scan: Scan,
    likelihood: ScanLikelihood,
    log_weight: Float[Array, "P"],
    log_likelihood: Float[Array, ""],
) -> Info:
    """The `Info` of the most likely particle, with the weighted mean NIS."""
    best = jnp.argmax(log_weight)
    likeliest: ScanLikelihood = jax.tree.map(lambda leaf: leaf[best], likelihood)
    return info_of(
        status_of(
            scan.valid,
            matched=likeliest.matched,
            positive=likeliest.positive,
            inside=likeliest.inside,
        ),
        likeliest.matched,
        size=likeliest.dof,
        slot=likeliest.slot,
        nis=weighted_nis(likelihood.nis, likelihood.matched, log_weight),
        innovation=likeliest.innovation,
        innovation_cov=likeliest.innovation_cov,
        log_likelihood=log_likelihood,
        exhausted=likelihood.exhausted.any(),
    )
