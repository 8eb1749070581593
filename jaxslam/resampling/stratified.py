"""Stratified resampling: one draw in each of P equal strata of the cumulative sum."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxslam.resampling.weights import at_points, weights_of


def stratified(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) where points (i + u_i)/P, u_i uniform and independent, fall; ascending.

    Unbiased as `multinomial`; the number of copies of j is within 2 of P w_j (Kitagawa 1996, "Monte
    Carlo filter and smoother for non-Gaussian nonlinear state space models", JCGS 5(1)).

    Args:
        log_weights: of any scale; what is not finite is never drawn, unless nothing is.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    count = weights.shape[0]
    u = jax.random.uniform(key, (count,), weights.dtype)
    return at_points(weights, (jnp.arange(count) + u) / count)
