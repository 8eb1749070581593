"""Noise covariances of models: constant, or a function of the state or the measurement."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.record import Function, is_record, record, static
from jaxslam.core.validation import Check, InvalidField, covariance, require

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
                "",
                f"expected a covariance (n, n), got {np.shape(self.cov)}: a stack of filters or "
                "worlds goes through jax.vmap, as "
                "jax.vmap(run, in_axes=(0, None, None, None, None))(stack, …)",
            )
        return jnp.asarray(self.cov, arguments[0].dtype)


@record
class _CovarianceFunction(Function):
    """A plain function that returns a covariance, which is checked where its numbers are known."""

    owner: str = static()
    """the class of the model"""
    size: int = static()

    def __call__(self, *arguments: jax.Array) -> jax.Array:
        cov = require(self.owner, "noise_cov", self.function(*arguments), covariance(self.size))
        return jnp.asarray(cov, arguments[0].dtype)


def noise_of(owner: str, size: int) -> Check:
    """The check of a model's noise_cov (size, size), which it makes a record that can be called."""

    def check(value: NoiseCov) -> object:
        if is_record(value):
            return value
        if callable(value):
            return _CovarianceFunction(value, owner, size)
        return Constant(covariance(size)(value))

    return check
