"""The covariance of the likelihood over a lattice of poses (Olson 2009)."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core.numbers import check_positive
from jaxslam.matching.covariance.record import (
    MatchCovariance,
    MatchedScans,
    beside_prior,
    curvature,
    inverse_of,
    stated,
)
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.prior import prior_cost
from jaxslam.math import linalg


def lattice(
    sigma: ArrayLike, *, window: float = 0.3, turn_window: float = 0.3, steps: int = 13
) -> MatchCovariance:
    """The covariance of p(x) ∝ exp(-E(x)/σ²) over a lattice of steps³ poses around the match.

    K = Σ p x xᵀ, u = Σ p x, and the covariance K - u uᵀ with Σ p = 1. The lattice is x̂ + L z, z in
    [-4, 4]³, L Lᵀ the inverse of ∂²E/∂x²/σ² and the window's information: as fine as the peak
    needs, and as wide as the window where nothing else bounds it. Residuals are evaluated at each
    pose: in a grid all that a shift changes counts, with the pairs of an ICP kept.

    Olson 2009, "Real-time correlative scan matching", ICRA, where the lattice is the search's.

    Args:
        sigma: standard deviation of a residual [m].
        window, turn_window: standard deviations of a prior [m], [rad], beside that of the match.
        steps: along each axis.
    """
    check_positive("lattice", sigma=sigma)
    if steps < 3 or not (window > 0 and turn_window > 0):
        raise ValueError(
            "lattice: expected steps >= 3 and windows above 0, got "
            f"{steps}, {window}, {turn_window}"
        )
    axis = np.linspace(-4.0, 4.0, steps)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    prior = np.array([window, window, turn_window]) ** -2.0

    def of(matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        reference, points, found, *_ = scans
        prepared = matcher.prepare(reference)
        dtype = found.pose.dtype
        alone = found._replace(prior=None)
        bound = jnp.diag(jnp.asarray(prior, dtype))
        variance = jnp.asarray(sigma) ** 2
        shape = curvature(matcher, prepared, points, found) / variance + bound
        peak = inverse_of(shape, beside_prior(found, found.information) / variance + bound)
        root = linalg.cholesky(peak)[0]
        offset = jnp.asarray(grid, dtype) @ root.T

        def one(shift: Array) -> Array:
            far = (shift * (bound @ shift)).sum()
            here = prior_cost(found.prior, found.pose + shift)
            if found.prior is not None:
                shift = found.determined @ shift
            here = here + matcher.cost(prepared, points, found.pose + shift, alone)
            return -here / jnp.asarray(sigma) ** 2 - 0.5 * far

        weight = jax.nn.softmax(jax.lax.map(one, offset, batch_size=64))
        mean = weight @ offset
        apart = offset - mean[None]
        return (weight[:, None] * apart).T @ apart

    return stated("lattice", of, sigma)
