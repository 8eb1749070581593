"""Noise covariances of models: constant, or a function of the state or the measurement."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core._record import record
from jaxslam.core.validation import InvalidField

__all__ = ["Constant", "NoiseCov"]

NoiseCov = ArrayLike | Callable[..., jax.Array]
"""Noise covariance: a matrix, or a function that returns one, plain or a record with `__call__`."""


@record
class Constant:
    """A constant covariance, called with anything."""

    cov: ArrayLike
    """(n, n)"""

    def __call__(self, *arguments: jax.Array) -> jax.Array:
        if np.ndim(self.cov) > 2:
            raise InvalidField(
                "noise_cov",
                f"expected a covariance (n, n), got {np.shape(self.cov)}: a stack of filters or "
                "worlds goes through jax.vmap, as "
                "jax.vmap(run, in_axes=(0, None, None, None, None))(stack, …)",
            )
        return jnp.asarray(self.cov, arguments[0].dtype)
