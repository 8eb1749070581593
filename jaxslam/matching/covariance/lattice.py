"""The covariance of the likelihood over a lattice of poses (Olson 2009)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam.core.numbers import check_count, check_positive
from jaxslam.core.record import record, static
from jaxslam.matching.covariance.record import (
    MatchCovariance,
    MatchedScans,
    beside_prior,
    curvature,
    inverse_of,
)
from jaxslam.matching.matcher import Matcher
from jaxslam.matching.prior import prior_cost
from jaxslam.math import linalg
from jaxslam.math.arrays import Number


@record
class Lattice(MatchCovariance):
    """The covariance of p(x) ∝ exp(-E(x)/σ²) over a lattice of steps³ poses around the match.

    K = Σ p x xᵀ, u = Σ p x, and the covariance K - u uᵀ with Σ p = 1. The lattice is x̂ + L z, z in
    [-4, 4]³, L Lᵀ the inverse of ∂²E/∂x²/σ² and the window's information: as fine as the peak
    needs, and as wide as the window where nothing else bounds it. Residuals are evaluated at each
    pose: in a grid all that a shift changes counts, with the pairs of an ICP kept.

    Olson 2009, "Real-time correlative scan matching", ICRA, where the lattice is the search's.
    """

    sigma: ArrayLike
    """standard deviation of a residual [m]"""
    _: dataclasses.KW_ONLY
    window: Number = 0.3
    """[m] and"""
    turn_window: Number = 0.3
    """[rad]: standard deviations of a prior, beside that of the match"""
    steps: int = static(default=13)
    """along each axis"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("Lattice", window=self.window, turn_window=self.turn_window)
        check_count("Lattice: steps", self.steps, 3)

    def of_usable(self, matcher: Matcher, scans: MatchedScans) -> Float[Array, "3 3"]:
        axis = np.linspace(-4.0, 4.0, self.steps)
        grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
        reference, points, found, *_ = scans
        prepared = matcher.prepare(reference)
        dtype = found.pose.dtype
        alone = found._replace(prior=None)
        windows = jnp.asarray([self.window, self.window, self.turn_window], dtype)
        bound = jnp.diag(windows**-2.0)
        variance = jnp.asarray(self.sigma, dtype) ** 2
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
            return -here / variance - 0.5 * far

        weight = jax.nn.softmax(jax.lax.map(one, offset, batch_size=64))
        mean = weight @ offset
        apart = offset - mean[None]
        return (weight[:, None] * apart).T @ apart
