"""What uncertain parameters add to the covariance of a result."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam import programs


def consider_cov(
    result: Callable[[jax.Array], jax.Array], parameters: ArrayLike, cov: ArrayLike
) -> Float[np.ndarray, "*shape n n"]:
    """The covariance that uncertain parameters add to each row of a result.

        J C Jᵀ,    J = ∂ result / ∂ p

    A filter takes the constants of its models for exact. Where they have the covariance C and its
    estimate the covariance P for given p, the estimate's covariance is P + J C Jᵀ to first order
    (consider covariance: Schmidt 1966; Tapley, Schutz & Born, "Statistical Orbit Determination",
    2004, section 6.4). J is of the whole run, in forward mode.

        added = consider_cov(lambda p: run(filter_of(p), …).estimate.pose, found.parameters,
            found.cov)
        honest = trace.estimate.pose_cov + added

    Args:
        result: p (P,) -> an array (*shape, n), as poses (T, 3). Traced once.
        parameters: (P,), or a number: where J is taken.
        cov: (P, P) C, or a number.
    Raises:
        ValueError: on parameters that are no finite vector, a covariance that is none or of another
            size, a result that is a scalar or not real, or whose derivatives are not finite.
    """
    p = np.atleast_1d(np.asarray(parameters, np.float64))
    if p.ndim != 1 or not p.size or not np.isfinite(p).all():
        raise ValueError(
            f"consider_cov: expected parameters of shape (P,), finite, got {parameters!r}"
        )
    c = np.asarray(cov, np.float64)
    c = c.reshape(1, 1) if c.ndim == 0 else c
    if c.shape != (p.size, p.size) or not np.isfinite(c).all() or not np.allclose(c, c.T):
        raise ValueError(
            f"consider_cov: expected a covariance of shape {(p.size, p.size)}, symmetric, got one "
            f"of shape {c.shape}"
        )
    if np.linalg.eigvalsh(c)[0] < -1e-9 * np.abs(c).max(initial=0.0):
        raise ValueError("consider_cov: expected a covariance, got one with a negative eigenvalue")
    what = jax.eval_shape(result, jax.ShapeDtypeStruct(p.shape, jnp.asarray(p).dtype))
    shape, dtype = getattr(what, "shape", ()), getattr(what, "dtype", None)
    if not shape or dtype is None or not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(
            "consider_cov: expected result to return an array (*shape, n) of real numbers, got "
            f"{what}"
        )
    jacobian = np.asarray(jax.device_get(programs.call(jax.jacfwd(result), (), jnp.asarray(p))))
    if not np.isfinite(jacobian).all():
        raise ValueError(f"consider_cov: the derivatives at {p} are not finite")
    return np.asarray(jacobian @ c @ np.swapaxes(jacobian, -1, -2))
