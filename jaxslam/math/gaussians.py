"""Gaussian densities by the Cholesky factor: distance, log-determinant, log-density."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.math import linalg

LOG_2PI = math.log(2 * math.pi)


class GaussianTerms(NamedTuple):
    """What N(error; 0, cov) is made of; finite also where cov is not positive definite."""

    factor: jax.Array
    """(n, n) L, lower triangular, cov = L Lᵀ"""
    whitened: jax.Array
    """(n,) L⁻¹ error"""
    distance: jax.Array
    """() d² = errorᵀ cov⁻¹ error"""
    log_det: jax.Array
    """() log |cov|"""
    log_density: jax.Array
    """() log N(error; 0, cov) = -(d² + log |cov| + n log 2π)/2"""
    positive: jax.Array
    """() bool: cov is positive definite"""


def gaussian_terms(error: jax.Array, cov: jax.Array) -> GaussianTerms:
    """The terms of the density of an error (n,) with a covariance (n, n)."""
    factor, positive = linalg.cholesky(cov)
    whitened = linalg.solve_lower(factor, error)
    distance = linalg.total(whitened**2)
    log_det = log_det_of(factor)
    density = log_density(distance, log_det, error.shape[0])
    return GaussianTerms(factor, whitened, distance, log_det, density, positive)


def log_det_of(factor: jax.Array) -> jax.Array:
    """log |L Lᵀ| () of a Cholesky factor L (n, n); a pivot that is not positive counts as 1."""
    pivots = jnp.diagonal(factor)
    return 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum()


def log_density(distance: jax.Array, log_det: jax.Array, size: int) -> jax.Array:
    """log N of errors of `size` entries, by their d² and log |cov|, of any shape."""
    return -0.5 * (distance + log_det + size * LOG_2PI)
