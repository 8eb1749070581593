"""The prior of the unmeasured landmark parameters: Solà's s ~ N(s̄, S), checked by the sensor."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.core.numbers import check_covariance, is_concrete
from jaxslam.protocols import Free
from jaxslam.types import JaxOrNumPy

FreeLike = Free | tuple[ArrayLike, ArrayLike]


def free_parameters(name: str, free: FreeLike, size: int) -> Free:
    """The `Free` of free = (mean (size,), cov (size, size)), in float64 on the host unless traced.

    Raises ValueError unless the mean is finite and the covariance positive definite; a traced part
    is checked for its shape alone.
    """
    try:
        mean, cov = free
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected free = (mean, covariance), got {free!r}") from None
    mean, cov = _held(mean), _held(cov)
    if mean.shape != (size,):
        raise ValueError(f"{name}: expected a prior mean of shape ({size},), got {mean.shape}")
    if is_concrete(mean) and not (_is_real(mean) and np.all(np.isfinite(mean))):
        raise ValueError(f"{name}: expected a finite prior mean, got {mean}")
    check_covariance(f"{name}: prior", cov, size)
    if is_concrete(cov) and not np.linalg.eigvalsh(np.asarray(cov, np.float64))[0] > 0:
        raise ValueError(f"{name}: expected a positive definite prior covariance")
    return Free(mean, cov)


def _held(values: ArrayLike) -> JaxOrNumPy:
    """The array on the host in float64, whatever the default width of JAX."""
    if not is_concrete(values):
        return jnp.asarray(values)
    array = np.asarray(values)
    return array.astype(np.float64) if _is_real(array) else array


def _is_real(array: JaxOrNumPy) -> bool:
    return bool(np.issubdtype(array.dtype, np.number)) and not np.iscomplexobj(array)
