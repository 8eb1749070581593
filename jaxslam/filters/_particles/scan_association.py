"""Data association of a scan with the landmarks of one particle, and the gate in its weights."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.protocols import Associate, Association, Prediction
from jaxslam.core.types import Scan
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import is_inside
from jaxslam.math.stats import chi2_quantile

_NEAR = 0.99
"""The probability that a measurement of a landmark lies within d², without a gate."""


class ParticleAssociation(NamedTuple):
    """The association of M measurements with the map of one particle."""

    slot: Int[Array, "*P M"]
    """slot of the measured landmark, 0 without one"""
    matched: Bool[Array, "*P M"]
    is_new: Bool[Array, "*P M"]
    exhausted: Bool[Array, "*P"]
    """the search ended at its budget"""


def particle_association(
    prediction: Prediction, scan: Scan, associate: Associate
) -> ParticleAssociation:
    """The association of the valid measurements of a scan."""
    association = Association(*associate(prediction, scan))
    return ParticleAssociation(
        # -1, for no slot, becomes index 0; what is read there is masked by `matched`.
        slot=jnp.maximum(association.slot, 0),
        matched=scan.valid & (association.slot >= 0) & ~association.is_new,
        is_new=scan.valid & association.is_new,
        exhausted=jnp.asarray(association.exhausted),
    )


def zero_padding(scan: Scan) -> Scan:
    """The scan with its padding set to zero; padding may hold any value."""
    return scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))


def unmatched_distance(gate: Number | None, size: int) -> Number:
    """The d² in a weight of a measurement without a landmark: γ, without a gate that of `_NEAR`.

    size: numbers Z of a measurement.
    """
    return chi2_quantile(_NEAR if gate is None else gate, size)


def gate_distance(
    distance: Float[Array, "*M"], gamma: Number | None
) -> tuple[Bool[Array, "*M"], Float[Array, "*M"], Float[Array, "*M"]]:
    """The gate on squared Mahalanobis distances d².

    gamma: the largest d² within the gate; None without one.

    Returns:
        Mask of the distances within the gate (without one, of those that are finite); d² in the
        weight, at most γ; and d² in `Info`, half the largest float where it is not finite.
    """
    finite = jnp.isfinite(distance)
    if gamma is not None:
        gamma = jnp.asarray(gamma, distance.dtype)
    inside = is_inside(distance, gamma)
    counted = distance if gamma is None else jnp.where(inside, distance, gamma)
    # Half of it, so that a mean over particles with weights that sum to 1 + eps stays finite.
    largest = 0.5 * float(jnp.finfo(distance.dtype).max)
    return inside, counted, jnp.where(finite, distance, largest)
