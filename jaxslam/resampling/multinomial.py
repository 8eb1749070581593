"""Multinomial resampling: independent draws, the method of the largest variance."""

import jax
from jax import Array
from jaxtyping import Float, Int

from jaxslam.resampling.weights import at_points, weights_of


def multinomial(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by multinomial resampling: P independent draws with P(a_i = j) = w_j.

    The number of copies of j has mean P w_j and variance P w_j (1 - w_j) (Gordon, Salmond & Smith
    1993, "Novel approach to nonlinear/non-Gaussian Bayesian state estimation", IEE Proc. F 140(2)).

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    return at_points(weights, jax.random.uniform(key, weights.shape, weights.dtype))
