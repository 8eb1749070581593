"""Noise covariances of factories, given as arrays or as functions."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxslam.validation.numbers import check_covariance

NoiseCov = ArrayLike | Callable[..., jax.Array]


def noise_model(name: str, noise_cov: NoiseCov, size: int) -> Callable[..., jax.Array]:
    """A function (…) -> (size, size) in the dtype of its first argument.

    An array is checked once (shape, finite, symmetric, positive semi-definite; ValueError) and held
    constant; the shape of a function's result is checked when it is traced.
    """
    if callable(noise_cov):

        def varying(*arguments: jax.Array) -> jax.Array:
            cov = noise_cov(*arguments)
            check_covariance(name, cov, size)
            return jnp.asarray(cov, arguments[0].dtype)

        return varying
    check_covariance(name, noise_cov, size)

    def constant(*arguments: jax.Array) -> jax.Array:
        return jnp.asarray(noise_cov, arguments[0].dtype)

    return constant
