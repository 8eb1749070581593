"""The likelihood of a scan given a pose in a known map.

All functions act on one pose; `particle_localization` vmaps them. Pose and map have no error here,
so the covariance of an innovation is the sensor's noise R(ẑ), which differs between poses.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.association._rules import predicted
from jaxslam.core.protocols import Prediction
from jaxslam.core.types import Scan
from jaxslam.filters._particles.particle_settings import KnownMapSensor
from jaxslam.filters._particles.scan_association import (
    ParticleAssociation,
    gate_distance,
    particle_association,
)
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import gaussian_terms, log_density, log_det_of
from jaxslam.sensors._suite import split_scan


class ScanLikelihood(NamedTuple):
    """The likelihood of a scan at one pose, for each measurement."""

    measured: Bool[Array, "*P M"]
    """a measurement that enters the likelihood"""
    slot: Int[Array, "*P M"]
    """of the landmark measured; -1 of an absolute sensor"""
    matched: Bool[Array, "*P M"]
    positive: Bool[Array, "*P M"]
    """R(ẑ) is positive definite"""
    inside: Bool[Array, "*P M"]
    """in the gate; without one, of a d² that did not overflow"""
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
    """log |R(ẑ)| - log |R(z)| of measurements matched to a landmark, else 0; the latter is the same
    at all poses"""
    log_density: Float[Array, "*P M"]
    """-(counted + log |2πR(ẑ)|)/2 of measurements matched to a landmark, else 0"""
    exhausted: Bool[Array, "*P"]
    """of the association"""


def scan_likelihood(
    pose: Float[Array, "3"], scan: Scan, sensors: tuple[KnownMapSensor, ...]
) -> ScanLikelihood:
    """The likelihood of the scan of a suite of sensors.

    Raises ValueError if the scan does not have their slots.
    """
    m, widest = scan.z.shape
    counts = [m if each.measured is None else each.measured for each in sensors]
    found = []
    for each, part in zip(sensors, split_scan(scan, counts), strict=True):
        size = len(each.sensor.measurements)
        of_sensor = _ignored_likelihood if each.ignored else _sensor_likelihood
        one, spare = of_sensor(pose, part._replace(z=part.z[:, :size]), each), widest - size
        innovation = jnp.pad(one.innovation, [(0, 0), (0, spare)])
        cov = jnp.pad(one.innovation_cov, [(0, 0), (0, spare), (0, spare)])
        one = one._replace(innovation=innovation, innovation_cov=cov)
        found.append(one._replace(exhausted=one.exhausted[None]))
    whole: ScanLikelihood = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    return whole._replace(exhausted=whole.exhausted.any())


def _sensor_likelihood(
    pose: Float[Array, "3"], scan: Scan, settings: KnownMapSensor
) -> ScanLikelihood:
    """The likelihood of one sensor's measurements.

    A measurement outside the gate gets d² = γ of the gate, and one without a landmark
    `unmatched_distance`, so that a particle with fewer associations is not preferred. With a gate
    no weight underflows because of a single outlier.
    """
    sensor = settings.sensor
    size_z, size_l = len(sensor.measurements), len(sensor.landmark)
    # In a suite an absolute sensor, whose landmarks have no parameters, shares the others' map.
    landmarks = jnp.asarray(settings.landmarks, pose.dtype)[:, :size_l]
    slot, matched, _, exhausted = _associate_known(pose, scan, landmarks, settings)
    z_hat = jax.vmap(sensor.observe, (None, 0))(pose, landmarks[slot])
    noise = jax.vmap(partial(predicted_noise, sensor))(z_hat, scan.z, matched)
    nu = jax.vmap(sensor.residual)(scan.z, z_hat)
    terms = jax.vmap(gaussian_terms)(nu, noise)
    factor_at_z = jax.vmap(lambda z: linalg.cholesky(sensor.noise_cov(z))[0])(scan.z)
    gated = gate_distance(terms.distance, settings.gamma)
    of_map = matched & terms.positive
    far = jnp.asarray(settings.unmatched_distance, scan.z.dtype)
    unmatched = jnp.where(scan.valid, far, 0.0)
    counted = jnp.where(of_map, gated.counted, unmatched)
    density = log_density(counted, terms.log_det, size_z)
    return ScanLikelihood(
        measured=scan.valid,
        slot=slot if sensor.landmark else jnp.full_like(slot, -1),
        matched=matched,
        positive=terms.positive,
        inside=gated.inside,
        innovation=jnp.where(matched[:, None], nu, 0.0),
        innovation_cov=jnp.where(matched[:, None, None], noise, 0.0),
        nis=jnp.where(matched, gated.reported, 0.0),
        dof=jnp.full_like(slot, size_z),
        counted=counted,
        spread=jnp.where(of_map, terms.log_det - jax.vmap(log_det_of)(factor_at_z), 0.0),
        log_density=jnp.where(of_map, density, 0.0),
        exhausted=exhausted,
    )


def _ignored_likelihood(
    pose: Float[Array, "3"], scan: Scan, settings: KnownMapSensor
) -> ScanLikelihood:
    """The likelihood of ignored measurements, such as those of other robots: zero terms."""
    m, size = scan.z.shape
    zero, none, no = (jnp.zeros(m, kind) for kind in (pose.dtype, jnp.int32, bool))
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


def _associate_known(
    pose: Float[Array, "3"],
    scan: Scan,
    landmarks: Float[Array, "N L"],
    settings: KnownMapSensor,
) -> ParticleAssociation:
    """The association with a known map; an absolute sensor needs none."""
    if not settings.sensor.landmark:
        none = jnp.zeros(scan.tag.shape, jnp.int32)
        return ParticleAssociation(none, scan.valid, jnp.zeros_like(scan.valid), jnp.asarray(False))
    prediction = _predict_known(pose, landmarks, settings)
    return particle_association(prediction, scan, settings.associate)


def _predict_known(
    pose: Float[Array, "3"], landmarks: Float[Array, "N L"], settings: KnownMapSensor
) -> Prediction:
    """The `Prediction` of a known map from an exact pose: S_ij = R(ẑ_j)."""
    sensor, count = settings.sensor, landmarks.shape[0]
    size = len(sensor.measurements)

    def measurements() -> tuple[Float[Array, "N Z"], None]:
        return jax.vmap(sensor.observe, (None, 0))(pose, landmarks), None

    def cross() -> Float[Array, "N Z N Z"]:
        return jnp.zeros((count, size, count, size), pose.dtype)

    alive = jnp.ones(count, bool)
    return predicted(sensor, jnp.asarray(settings.tags), alive, measurements, cross)
