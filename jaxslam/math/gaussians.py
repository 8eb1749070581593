"""Gaussian densities by the Cholesky factor: distance, log-determinant, log-density."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxslam.math import linalg
from jaxslam.math.arrays import Scalar

LOG_2PI = math.log(2 * math.pi)


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
    """log |L Lᵀ| of a Cholesky factor L; a pivot that is not positive counts as 1."""
    pivots = jnp.diagonal(factor)
    return 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum()


def log_density(
    distance: Float[Array, "..."], log_det: Float[Array, "..."], size: int
) -> Float[Array, "..."]:
    """log N of errors of `size` entries, by their d² and log |cov|."""
    return -0.5 * (distance + log_det + size * LOG_2PI)
