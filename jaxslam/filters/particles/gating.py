"""The gate on squared Mahalanobis distances in particle weights."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxslam.math.arrays import Number


class GatedDistance(NamedTuple):
    """A squared Mahalanobis distance d² after the gate, of any shape."""

    inside: Bool[Array, "..."]
    """within the gate; without one, d² is finite"""
    counted: Float[Array, "..."]
    """d² in the weight, clipped at the gate"""
    reported: Float[Array, "..."]
    """d², a large number where it is not finite"""


def gate_distance(distance: Float[Array, "*M"], gate: Number | None) -> GatedDistance:
    """The gated distance: whether d² passes, and its values for weights and for `Info`."""
    finite = jnp.isfinite(distance)
    if gate is not None:
        gate = jnp.asarray(gate, distance.dtype)
    inside = finite if gate is None else finite & (distance <= gate)
    counted = distance if gate is None else jnp.where(inside, distance, gate)
    largest = 0.5 * float(jnp.finfo(distance.dtype).max)
    return GatedDistance(inside, counted, jnp.where(finite, distance, largest))
