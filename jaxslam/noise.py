"""Noise covariances as factories take them: an array, or a function of what they depend on."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.math.linalg import check_covariance, is_concrete

NoiseCov = ArrayLike | Callable[..., jax.Array]


def noise_model(name: str, noise_cov: NoiseCov, size: int) -> Callable[..., jax.Array]:
    """A function (…) -> (size, size) in the dtype of its first argument.

    An array is checked once (shape, finite, symmetric, positive semi-definite; ValueError) and held
    constant; a function is taken as it is and its result is checked for shape when traced.
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


def check_alpha(name: str, alpha: ArrayLike, count: int) -> None:
    """Raise ValueError unless alpha holds `count` real, finite numbers >= 0, the αs of a noise.

    Values are looked at only where they are concrete; a tracer is checked for its shape alone.
    """
    shape = np.shape(alpha) if is_concrete(alpha) else jnp.asarray(alpha).shape
    if shape != (count,):
        raise ValueError(f"{name}: expected alpha of shape ({count},), got {shape}")
    if not is_concrete(alpha):
        return
    values = np.asarray(alpha)
    if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        raise ValueError(f"{name}: expected alpha of real numbers, got dtype {values.dtype}")
    if not np.all(np.isfinite(values)) or np.any(values < 0):
        raise ValueError(f"{name}: expected alpha finite and not negative, got {values}")
