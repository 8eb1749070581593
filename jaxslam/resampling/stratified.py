"""Stratified resampling: one draw in each of P equal strata of the cumulative sum."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxslam.resampling.weights import at_points, weights_of


def stratified(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by stratified resampling, ascending: those of the points (i + u_i)/P.

    The u_i are uniform in [0, 1) and independent.

    Unbiased as `multinomial`; the number of copies of j is within 2 of P w_j (Kitagawa 1996, "Monte
    Carlo filter and smoother for non-Gaussian nonlinear state space models", JCGS 5(1)).

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    count = weights.shape[0]
    u = jax.random.uniform(key, (count,), weights.dtype)
    return at_points(weights, (jnp.arange(count) + u) / count)
