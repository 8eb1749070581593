"""The factor L of an innovation covariance S = L Lᵀ, and what it whitens: V = L⁻¹ H P, L⁻¹ ν."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import materialize, no_inline


class InnovationFactor(NamedTuple):
    """The factor of S = L Lᵀ of the fused measurements."""

    s: Float[Array, "m Z m Z"]
    factor: Float[Array, "m*Z m*Z"]
    inverse: Float[Array, "m Z Z"]
    """L_ii⁻¹ of S_ii, each measurement for itself"""
    pivots: Float[Array, "m Z"]
    """the diagonal of L, of one measurement that of L⁻¹"""
    regular: Bool[Array, "m"]


def factor_of(
    s: Float[Array, "m Z m Z"],
    same: Float[Array, "m 1 m 1"],
    inverse: Float[Array, "m Z Z"],
    definite: Bool[Array, "m"],
    fuse: Bool[Array, "m"],
) -> InnovationFactor:
    """The factor L of the fused measurements; for the others S is the identity and L zero.

    same: 1 where both measurements are the same one.
    """
    m, size_z = s.shape[:2]
    both = fuse[:, None, None, None] & fuse[None, None, :, None]
    unit = jnp.eye(size_z, dtype=s.dtype)
    s = materialize(jnp.where(both, s, same * unit[None, :, None]))
    factor = materialize(linalg.cholesky(s.reshape(m * size_z, m * size_z))[0])
    pivots = jnp.diagonal(factor).reshape(m, size_z)
    # Measurements that are regular one by one can still be singular together.
    regular = definite if m == 1 else (pivots > 0).all(axis=1)
    # A row without a pivot is zero and so has no effect, without a mask.
    factor = jnp.where(jnp.repeat(fuse & regular, size_z)[:, None], factor, 0.0)
    if m == 1:  # it has been factored already
        pivots = jnp.diagonal(inverse, axis1=1, axis2=2)
    return InnovationFactor(s, factor, inverse, pivots, regular)


def whiten(
    factored: InnovationFactor,
    fuse: Bool[Array, "m"],
    hp: Float[Array, "K D"],
    nu: Float[Array, "m Z"],
) -> tuple[Float[Array, "K D"], Float[Array, "K"]]:
    """The whitened rows V = L⁻¹ H P and innovations L⁻¹ ν, zero if not fused."""
    if len(fuse) == 1:
        inverse = jnp.where((fuse & factored.regular)[:, None, None], factored.inverse, 0.0)
        return no_inline(_multiply, inverse, hp, nu)
    # As a vector, the factor has one layout: LAPACK wants columns, and XLA (jaxlib 0.12) may pass
    # rows to a computation that was compiled for columns.
    return no_inline(_solve, factored.factor.reshape(-1), hp, nu.reshape(-1))


def _solve(
    factor: Float[Array, "KK"], hp: Float[Array, "K D"], nu: Float[Array, "K"]
) -> tuple[Float[Array, "K D"], Float[Array, "K"]]:
    """The whitened L⁻¹ H P and L⁻¹ ν by substitution."""
    factor = factor.reshape(len(nu), len(nu))
    both = linalg.solve_lower(factor, jnp.concatenate([hp, nu[:, None]], axis=1))
    return both[:, :-1], both[:, -1]


def _multiply(
    inverse: Float[Array, "1 Z Z"], hp: Float[Array, "Z D"], nu: Float[Array, "1 Z"]
) -> tuple[Float[Array, "Z D"], Float[Array, "Z"]]:
    """The whitened L⁻¹ H P and L⁻¹ ν of one measurement, by L⁻¹."""
    return whitened_by(inverse, hp[None])[0], whitened_by(inverse, nu[:, :, None]).reshape(-1)


@linalg.kept_whole
def whitened_by(
    inverse: Float[Array, "m Z Z"], rhs: Float[Array, "m Z k"]
) -> Float[Array, "m Z k"]:
    """The whitened rows L⁻¹ B of each measurement."""
    each = range(inverse.shape[1])
    return linalg.total(inverse[:, :, k, None] * rhs[:, k, None] for k in each)
