"""Noise covariances of models: constant, or a function of the state or the measurement."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core._numbers import check_covariance, held_array
from jaxslam.core._record import is_record, record, set_field, static

NoiseCov = ArrayLike | Callable[..., jax.Array]
"""As a model takes it: a covariance, a record with `__call__`, or a plain function."""


@record
class Constant:
    """A constant covariance, called with anything."""

    cov: ArrayLike
    """(n, n)"""

    def __call__(self, *arguments: jax.Array) -> jax.Array:
        if np.ndim(self.cov) > 2:
            raise ValueError(
                f"noise_cov: expected a covariance (n, n), got {np.shape(self.cov)}: a stack of "
                "filters or worlds goes through jax.vmap, as "
                "jax.vmap(run, in_axes=(0, None, None, None, None))(stack, …)"
            )
        return jnp.asarray(self.cov, arguments[0].dtype)


@record
class Function:
    """A plain function that returns a covariance; its numbers are not leaves."""

    function: Callable[..., jax.Array] = static()
    owner: str = static()
    size: int = static()

    def __call__(self, *arguments: jax.Array) -> jax.Array:
        cov = self.function(*arguments)
        check_covariance(self.owner, cov, self.size)
        return jnp.asarray(cov, arguments[0].dtype)


def hold_noise(model: object, size: int) -> None:
    """Make the field noise_cov of a model what can be called, in its `__post_init__`.

    Raises ValueError unless it is a covariance (size, size) or a function.
    """
    given, name = getattr(model, "noise_cov"), type(model).__name__  # noqa: B009
    if is_record(given):
        return
    where = f"{name}: noise_cov"
    if callable(given):
        set_field(model, "noise_cov", Function(given, where, size))
        return
    check_covariance(where, given, size)
    set_field(model, "noise_cov", Constant(held_array(given)))
