"""Data association of a scan with the landmarks of one particle, and the gate in its weights."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.protocols import Associate, Association, Prediction
from jaxslam.core.types import Scan
from jaxslam.math._arrays import Number


class ParticleAssociation(NamedTuple):
    """The association of M measurements with the map of one particle."""

    slot: Int[Array, "*P M"]
    """of the measured landmark, 0 without one"""
    matched: Bool[Array, "*P M"]
    is_new: Bool[Array, "*P M"]
    exhausted: Bool[Array, "*P"]
    """the search ended at its budget"""


def particle_association(
    prediction: Prediction, scan: Scan, associate: Associate
) -> ParticleAssociation:
    """The association of the valid measurements of a scan."""
    found = Association(*associate(prediction, scan))
    return ParticleAssociation(
        slot=jnp.maximum(found.slot, 0),
        matched=scan.valid & (found.slot >= 0) & ~found.is_new,
        is_new=scan.valid & found.is_new,
        exhausted=jnp.asarray(found.exhausted),
    )


def zero_padding(scan: Scan) -> Scan:
    """The scan with its padding set to zero; padding may hold any value."""
    return scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))


class _GatedDistance(NamedTuple):
    """A squared Mahalanobis distance d² after the gate, of any shape."""

    inside: Bool[Array, "..."]
    """within the gate; without one, d² is finite"""
    counted: Float[Array, "..."]
    """d² in the weight, at most γ"""
    reported: Float[Array, "..."]
    """d², a large number where it is not finite"""


def gate_distance(distance: Float[Array, "*M"], gamma: Number | None) -> _GatedDistance:
    """The gated distance: whether d² passes, and its values for weights and for `Info`.

    gamma: the largest d² within the gate; None without one.
    """
    finite = jnp.isfinite(distance)
    if gamma is not None:
        gamma = jnp.asarray(gamma, distance.dtype)
    inside = finite if gamma is None else finite & (distance <= gamma)
    counted = distance if gamma is None else jnp.where(inside, distance, gamma)
    largest = 0.5 * float(jnp.finfo(distance.dtype).max)
    return _GatedDistance(inside, counted, jnp.where(finite, distance, largest))
