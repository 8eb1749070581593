"""Independent draws: the plain bootstrap, and the noisiest."""

import jax

from jaxslam.resampling.weights import at_points, weights_of


def multinomial(log_weights: jax.Array, key: jax.Array) -> jax.Array:
    """Ancestors (P,): P independent draws with P(a_i = j) = w_j.

    The number of copies of j has mean P w_j and variance P w_j (1 - w_j) (Gordon, Salmond & Smith
    1993, "Novel approach to nonlinear/non-Gaussian Bayesian state estimation", IEE Proc. F 140(2)).

    Args:
        log_weights: (P,), of any scale; what is not finite is never drawn, unless nothing is.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    return at_points(weights, jax.random.uniform(key, weights.shape, weights.dtype))
