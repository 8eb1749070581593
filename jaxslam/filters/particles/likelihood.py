"""How well a scan fits one particle's pose in a known map.

Everything here acts on one particle; `filters.particle_localization` vmaps it. The pose has no
error of its own and the map none at all, so the covariance of an innovation is the sensor's noise.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.math import linalg
from jaxslam.protocols import Associate, Association, Pairs, Prediction, Sensor
from jaxslam.types import Scan

Array = jax.Array

_LOG_2PI = math.log(2 * math.pi)


class ScanLikelihood(NamedTuple):
    """A scan against one particle, place by place."""

    there: Array
    """(M,) bool: a measurement that counts"""
    slot: Array
    """(M,) of the landmark measured, -1 where none"""
    matched: Array
    """(M,) bool"""
    used: Array
    """(M,) bool: matched, in the gate, and R positive definite"""
    positive: Array
    """(M,) bool: its R is positive definite"""
    inside: Array
    """(M,) bool: in the gate; without one, of a d² that did not overflow"""
    innovation: Array
    """(M, Z)"""
    cov: Array
    """(M, Z, Z) R"""
    nis: Array
    """(M,) d² = νᵀ R⁻¹ ν"""
    counted: Array
    """(M,) d² as the weight has it: the gate's where it is beyond, the edge's where of no landmark,
    0 where there is no measurement"""
    log_density: Array
    """(M,) -(counted + log |2πR|)/2 of places matched to a landmark, else 0"""
    exhausted: Array
    """() bool, of the association"""


def scan_likelihood(
    pose: Array,
    scan: Scan,
    *,
    sensor: Sensor,
    landmarks: Any,
    tag: Any,
    absolute: bool,
    associate: Associate,
    gate: float | None,
    edge: float,
) -> ScanLikelihood:
    """`ScanLikelihood` of a scan with a pose (3,) in a map of landmarks (N, L) with tags (N,).

    A measurement outside the gate counts as one on the gate, and one that is of no landmark as one
    at d² = edge: a particle gains nothing by explaining less. So with a gate no weight underflows
    for a single outlier.
    """
    # In a suite an absolute sensor, whose landmarks have no parameters, shares the others' map.
    landmarks = jnp.asarray(landmarks, pose.dtype)[:, : len(sensor.landmark)]
    noise = jax.vmap(sensor.noise_cov)(scan.z)
    factor, positive = jax.vmap(linalg.cholesky)(noise)
    if absolute:
        slot, matched, exhausted = jnp.full_like(scan.tag, -1), scan.valid, jnp.asarray(False)
    else:
        found = Association(
            *associate(_prediction(pose, scan, sensor, landmarks, tag, factor, positive), scan)
        )
        # The map is known: what would be a new landmark is of none.
        matched = scan.valid & (found.slot >= 0) & ~found.is_new
        slot, exhausted = jnp.where(matched, found.slot, -1), jnp.asarray(found.exhausted)

    def place(z: Array, slot: Array, factor: Array) -> tuple[Array, Array]:
        nu = sensor.residual(z, sensor.observe(pose, landmarks[jnp.maximum(slot, 0)]))
        return nu, (linalg.solve_lower(factor, nu) ** 2).sum()

    nu, nis = jax.vmap(place)(scan.z, slot, factor)
    there = jnp.isfinite(nis)
    inside = there if gate is None else there & (nis <= gate)
    counted = nis if gate is None else jnp.where(inside, nis, gate)
    of_map = matched & positive
    counted = jnp.where(of_map, counted, jnp.where(scan.valid, edge, 0.0))
    log_det = jax.vmap(_log_det)(factor)
    log_density = -0.5 * (counted + log_det + nu.shape[1] * _LOG_2PI)
    return ScanLikelihood(
        there=scan.valid,
        slot=slot,
        matched=matched,
        used=of_map & inside,
        positive=positive,
        inside=inside,
        innovation=jnp.where(matched[:, None], nu, 0.0),
        cov=jnp.where(matched[:, None, None], noise, 0.0),
        nis=jnp.where(matched, jnp.where(there, nis, 0.5 * float(jnp.finfo(nis.dtype).max)), 0.0),
        counted=counted,
        log_density=jnp.where(of_map, log_density, 0.0),
        exhausted=exhausted,
    )


def no_fit(pose: Array, scan: Scan) -> ScanLikelihood:
    """Of places that are left alone, as those for other robots: nothing counts."""
    m, size = scan.z.shape
    zero, no = jnp.zeros(m, pose.dtype), jnp.zeros(m, bool)
    return ScanLikelihood(
        there=no,
        slot=jnp.full_like(scan.tag, -1),
        matched=no,
        used=no,
        positive=no,
        inside=no,
        innovation=jnp.zeros((m, size), pose.dtype),
        cov=jnp.zeros((m, size, size), pose.dtype),
        nis=zero,
        counted=zero,
        log_density=zero,
        exhausted=jnp.asarray(False),
    )


def in_order(
    pose: Array, scan: Scan, parts: list[tuple[int, int, Callable[[Array, Scan], ScanLikelihood]]]
) -> ScanLikelihood:
    """A scan whose first places are the first part's, and so on: (places, Z, fit) each.

    Raises ValueError if the scan does not have their places.
    """
    if sum(places for places, _, _ in parts) != scan.tag.shape[0]:
        wanted = tuple(places for places, _, _ in parts)
        raise ValueError(f"expected places {wanted} of a scan, got {scan.tag.shape[0]}")
    fits, at = [], 0
    for places, size, of_part in parts:
        own: Scan = jax.tree.map(lambda leaf, a=at, n=places: leaf[a : a + n], scan)
        found, spare = of_part(pose, own._replace(z=own.z[:, :size])), scan.z.shape[1] - size
        wide = {
            "innovation": jnp.pad(found.innovation, [(0, 0), (0, spare)]),
            "cov": jnp.pad(found.cov, [(0, 0), (0, spare), (0, spare)]),
        }
        fits.append(found._replace(**wide, exhausted=found.exhausted[None]))
        at += places
    whole: ScanLikelihood = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *fits)
    return whole._replace(exhausted=whole.exhausted.any())


def _log_det(factor: Array) -> Array:
    pivots = jnp.diagonal(factor)
    return 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum()


def _prediction(
    pose: Array,
    scan: Scan,
    sensor: Sensor,
    landmarks: Array,
    tag: Any,
    factor: Array,
    positive: Array,
) -> Prediction:
    """The map as an association may see it from a pose without error: S_ij = R_i."""
    count = landmarks.shape[0]

    def pairs(scan: Scan) -> Pairs:
        expected = jax.vmap(sensor.observe, (None, 0))(pose, landmarks)
        over_slots = jax.vmap(sensor.residual, (None, 0))
        nu = jax.vmap(over_slots, (0, None))(scan.z, expected)
        white = jax.vmap(jax.vmap(linalg.solve_lower, (None, 0)))(factor, nu)
        m, size = scan.z.shape
        noise = jax.vmap(sensor.noise_cov)(scan.z)
        return Pairs(
            innovation=nu,
            cov=jnp.broadcast_to(noise[:, None], (m, count, size, size)),
            distance=(white**2).sum(axis=2),
            log_det=jnp.broadcast_to(jax.vmap(_log_det)(factor)[:, None], (m, count)),
            possible=jnp.broadcast_to((scan.valid & positive)[:, None], (m, count)),
        )

    def cross() -> Array:
        size = scan.z.shape[1]
        return jnp.zeros((count, size, count, size), pose.dtype)

    return Prediction(jnp.asarray(tag), jnp.ones(count, bool), pairs, cross)
