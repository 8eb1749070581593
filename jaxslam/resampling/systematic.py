"""Systematic resampling: one draw, and P points at equal distances from it."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxslam.resampling.weights import at_points, weights_of


def systematic(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by systematic resampling, ascending: those of the points (i + u)/P.

    One u, uniform in [0, 1), is drawn for all i.

    The number of copies of j is P w_j rounded down or up, with mean P w_j: no particle of at least
    an even weight is lost (Carpenter, Clifford & Fearnhead 1999, "Improved particle filter for
    nonlinear problems", IEE Proc. Radar Sonar Navig. 146(1)).

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    count = weights.shape[0]
    u = jax.random.uniform(key, (), weights.dtype)
    return at_points(weights, (jnp.arange(count) + u) / count)
