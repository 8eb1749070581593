"""Gaussian densities by the Cholesky factor: distance, log-determinant, log-density."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number, Scalar

_LOG_2PI = math.log(2 * math.pi)


class GaussianTerms(NamedTuple):
    """The terms of log N(error; 0, cov); finite also where cov is not positive definite."""

    factor: Float[Array, "n n"]
    """L, lower triangular, cov = L Lᵀ"""
    whitened: Float[Array, "n"]
    """L⁻¹ error"""
    distance: Scalar
    """d² = errorᵀ cov⁻¹ error"""
    log_det: Scalar
    """log |cov|"""
    log_density: Scalar
    """log N(error; 0, cov) = -(d² + log |cov| + n log 2π)/2"""
    positive: Bool[Array, ""]
    """cov is positive definite"""


def gaussian_terms(error: Float[Array, "n"], cov: Float[Array, "n n"]) -> GaussianTerms:
    """The terms of log N(error; 0, cov)."""
    factor, positive = linalg.cholesky(cov)
    whitened = linalg.solve_lower(factor, error)
    distance = linalg.total(whitened**2)
    log_det = log_det_of(factor)
    density = log_density(distance, log_det, error.shape[0])
    return GaussianTerms(factor, whitened, distance, log_det, density, positive)


def log_det_of(factor: Float[Array, "n n"]) -> Scalar:
    """The log-determinant log |L Lᵀ| of a Cholesky factor L; pivots not above 0 count as 1."""
    return log_det_of_pivots(jnp.diagonal(factor))


def log_det_of_pivots(pivots: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """The log-determinant log |L Lᵀ| by the diagonal of L; of L⁻¹ it is the negative."""
    return 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum(axis=-1)


def log_density(
    distance: Float[Array, "..."], log_det: Float[Array, "..."], size: int
) -> Float[Array, "..."]:
    """The log-density of errors of `size` entries, by their d² and log |cov|."""
    return -0.5 * (distance + log_det + size * _LOG_2PI)


def is_inside(distance: Float[Array, "*batch"], gamma: Number | None) -> Bool[Array, "*batch"]:
    """Mask of the squared distances d² within the gate γ; None: of those that are finite.

    A finite error whose d² overflows is outside any gate, and so is a NaN.
    """
    return jnp.isfinite(distance) if gamma is None else distance <= gamma


def mahalanobis_squared(
    error: Float[Array, "n"], cov: Float[Array, "n n"]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The distance eᵀ P⁻¹ e, and whether P (n, n) is numerically regular; 0 and False if not.

    P is scaled by each coordinate's standard deviation, so that the test does not depend on units.
    Regular means that each Cholesky pivot exceeds 100 n·eps, so no direction is known exactly, and
    that e is finite.
    """
    n, variance = cov.shape[-1], jnp.diagonal(cov)
    spread = variance > 0  # √ has an infinite derivative at zero, hence the 1.0
    unit = jnp.where(spread, 1.0 / jnp.sqrt(jnp.where(spread, variance, 1.0)), 0.0)
    factor = linalg.cholesky(cov * unit[:, None] * unit[None, :])[0]
    is_finite = jnp.isfinite(error)
    squares = linalg.solve_lower(factor, jnp.where(is_finite, error, 0.0) * unit) ** 2
    # Pivots of a matrix with a unit diagonal: `cholesky` accepts n·eps, of which no digit is right.
    regular = jnp.all(jnp.diagonal(factor) ** 2 > 100 * n * jnp.finfo(cov.dtype).eps)
    regular = regular & jnp.all(is_finite)
    return jnp.where(regular, jnp.sum(squares), 0.0), regular
