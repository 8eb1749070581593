"""What uncertain parameters add to the covariance of a result."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxslam.core.numbers import is_concrete
from jaxslam.core.record import as_record


def consider_cov(
    result: Callable[[Float[Array, "P"]], Float[Array, "*shape n"]],
    parameters: ArrayLike,
    cov: ArrayLike,
) -> Float[np.ndarray, "*shape n n"]:
    """The covariance that uncertain parameters add to each row of a result.

        J C Jᵀ,    J = ∂ result / ∂ p

    A filter takes the constants of its models for exact. Where they have the covariance C and its
    estimate the covariance P for given p, the estimate's covariance is P + J C Jᵀ to first order
    (consider covariance: Schmidt 1966; Tapley, Schutz & Born, "Statistical Orbit Determination",
    2004, section 6.4). J is of the whole run, in forward mode; gates and associations stay as they
    are decided at p.

        added = consider_cov(lambda p: run(filter_of(p), …).estimate.pose, constants, cov)
        cov = trace.estimate.pose_cov + added

    This holds for constants that are independent of the log. Constants found in the same log, as by
    `calibrate`, depend on its noise: P + J C Jᵀ is then right at the last row, where it is the
    covariance of the joint estimate of state and constants, and in general too large before.

    Args:
        result: p (P,) -> an array (*shape, n), as poses (T, 3). Traced once; of a record with
            `__call__` once for all its numbers.
        parameters: where J is taken; a number counts as (1,).
        cov: (P, P) C, or a number for one parameter.
    Raises:
        ValueError: within a trace; on parameters that are no finite vector; on a covariance of
            another size, or that is none; on a result that is no array (*shape, n) of real numbers,
            or that is not finite at p, itself or its derivatives.
    """
    if not callable(result):
        raise ValueError(
            f"consider_cov: expected result to be a function of p, got {type(result).__name__}"
        )
    if not (is_concrete(parameters) and is_concrete(cov)):
        raise ValueError("consider_cov: computes on the host; call it outside jit, vmap and grad")
    p = np.atleast_1d(np.asarray(parameters, np.float64))
    if p.ndim != 1 or not p.size or not np.isfinite(p).all():
        raise ValueError(
            f"consider_cov: expected parameters of shape (P,), finite, got {parameters!r}"
        )
    c = _covariance(cov, p.size)

    found = jax.device_get(_differentiated(as_record(result), p))
    jacobian, value = (np.asarray(each, np.float64) for each in found)
    if not (np.isfinite(jacobian).all() and np.isfinite(value).all()):
        raise ValueError(f"consider_cov: the result or its derivatives at {p} are not finite")
    return np.asarray(jacobian @ c @ np.swapaxes(jacobian, -1, -2))


@partial(jax.jit, inline=True)
def _differentiated(
    result: Callable[[Float[Array, "P"]], Float[Array, "*shape n"]], p: Float[Array, "P"]
) -> tuple[Float[Array, "*shape n P"], Float[Array, "*shape n"]]:
    """The derivative of a result, and the result."""

    def both(p: Float[Array, "P"]) -> tuple[Array, Array]:
        value = result(p)
        array = isinstance(value, jax.Array)
        if not array or not value.shape or not jnp.issubdtype(value.dtype, jnp.floating):
            what = f"{value.shape} {value.dtype}" if array else type(value).__name__
            raise ValueError(
                "consider_cov: expected result to return an array (*shape, n) of real numbers, as "
                f"trace.estimate.pose, got {what}"
            )
        return value, value

    found: tuple[Array, Array] = jax.jacfwd(both, has_aux=True)(p)
    return found


def _covariance(cov: ArrayLike, size: int) -> Float[np.ndarray, "P P"]:
    """A covariance of so many parameters; raises ValueError on what is none, in any units."""
    c = np.asarray(cov, np.float64)
    c = c.reshape(1, 1) if c.ndim == 0 and size == 1 else c
    if c.shape != (size, size):
        raise ValueError(
            f"consider_cov: expected a covariance of shape {(size, size)}, got one of {c.shape}"
        )
    if not np.isfinite(c).all():
        raise ValueError("consider_cov: expected a covariance, got one that is not finite")
    if not np.allclose(c, c.T):
        raise ValueError("consider_cov: expected a covariance, got one that is not symmetric")
    deviation = np.sqrt(np.maximum(np.diag(c), 0.0))
    scale = np.outer(deviation, deviation)
    correlation = c / np.where(scale > 0, scale, 1.0)
    none = (np.diag(c) < 0).any() or (c[scale == 0] != 0).any()
    if none or np.linalg.eigvalsh(correlation)[0] < -1e-9:
        raise ValueError("consider_cov: expected a covariance, got one with a negative eigenvalue")
    return c
