"""The products and factors of a correction: H P, S = H P Hᵀ + R = L Lᵀ, and what L⁻¹ whitens.

m measurements of Z numbers are rows (m, Z) of one vector ν of K = m·Z numbers; a measurement
involves the robot and one landmark, so H has 3 + L columns a measurement, and no D×D product is
formed.

Why some lines are called by `no_inline` or stored by `materialize` (`math._xla`): XLA on a CPU
fuses a cheap producer into each of its consumers and computes it again there. What each of the D²
entries of P - Vᵀ V needs is therefore computed once and stored, here or where these functions are
called.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import log_det_of_pivots
from jaxslam.math._xla import materialize, no_inline


@linalg.rematerialize
def project(
    rows: Float[Array, "m Z C"], robot: Float[Array, "3 D"], landmark: Float[Array, "m L D"]
) -> Float[Array, "m Z D"]:
    """The product H P (m, Z, D) of H = rows[…, :3+L] with the rows of P that it involves.

    Written as a sum of 3 + L outer products, which XLA vectorizes over D; a batched matrix product
    of such thin matrices is a library call for each.
    """
    terms = [rows[:, :, k, None] * robot[None, None, k] for k in range(3)]
    terms += [rows[:, :, 3 + k, None] * landmark[:, None, k] for k in range(landmark.shape[1])]
    return linalg.total(terms)


def projected_cov(
    hp: Float[Array, "m Z D"],
    by_pose: Float[Array, "m Z 3"],
    by_landmark: Float[Array, "m Z L"],
    slot: Int[Array, "m"],
    capacity: int,
) -> Float[Array, "m Z m Z"]:
    """The covariance H P Hᵀ of predicted measurements, from the columns of H P that H meets."""
    m, size_z, size_l = by_landmark.shape
    # Axes: measurement and entry of the first, measurement and entry of the second.
    cov = linalg.total(hp[:, :, k, None, None] * by_pose[None, None, :, :, k] for k in range(3))
    if size_l == 0:
        return cov
    # Columns of H P by landmark: measurement and entry, then slot and entry (m, Z, N, L); of these
    # the landmark of each measurement, (m, Z, m, L).
    by_slot = hp[:, :, 3 : 3 + capacity * size_l].reshape(m, size_z, capacity, size_l)
    at_landmark = by_slot[:, :, slot]
    return cov + linalg.total(
        at_landmark[..., k, None] * by_landmark[None, None, :, :, k] for k in range(size_l)
    )


class InnovationFactor(NamedTuple):
    """The factor of S = L Lᵀ of the fused measurements."""

    s: Float[Array, "m Z m Z"]
    """S; the identity for measurements that are not fused"""
    factor: Float[Array, "K K"]
    """L; rows of zeros for measurements that are not fused"""
    inverse: Float[Array, "m Z Z"]
    """L_ii⁻¹ of each S_ii = L_ii L_iiᵀ alone"""
    log_det: Float[Array, "m"]
    """log |S_ii| given the measurements before it"""
    regular: Bool[Array, "m"]
    """the measurement's pivots of L are positive"""


def factor_of(
    s: Float[Array, "m Z m Z"],
    inverse: Float[Array, "m Z Z"],
    definite: Bool[Array, "m"],
    fuse: Bool[Array, "m"],
) -> InnovationFactor:
    """The factor L of the S of the measurements that are fused.

    inverse, definite: L_ii⁻¹ of each S_ii alone, and whether S_ii is positive definite.
    """
    m, size_z = s.shape[:2]
    diagonal = jnp.eye(m, dtype=s.dtype)[:, None, :, None]  # (m, 1, m, 1)
    both = fuse[:, None, None, None] & fuse[None, None, :, None]
    # The identity where not fused, apart from all others: then S is regular if its fused part is.
    unit = jnp.eye(size_z, dtype=s.dtype)
    s = materialize(jnp.where(both, s, diagonal * unit[None, :, None]))
    # (m, Z, m, Z) -> (K, K): row i·Z + j is entry j of measurement i.
    factor = materialize(linalg.cholesky(s.reshape(m * size_z, m * size_z))[0])
    pivots = jnp.diagonal(factor).reshape(m, size_z)
    # Measurements that are regular one by one can still be singular together.
    regular = definite if m == 1 else (pivots > 0).all(axis=1)
    # A row without a pivot is zero and so has no effect, without a mask.
    factor = jnp.where(jnp.repeat(fuse & regular, size_z)[:, None], factor, 0.0)
    if m == 1:  # S is S_ii, whose L⁻¹ is at hand: the pivots of L need not be computed
        # The pivots of L⁻¹ are one over those of L, so the sign turns.
        log_det = -log_det_of_pivots(jnp.diagonal(inverse, axis1=1, axis2=2))
    else:
        log_det = log_det_of_pivots(pivots)
    return InnovationFactor(s, factor, inverse, log_det, regular)


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
    return no_inline(_substitute, factored.factor.reshape(-1), hp, nu.reshape(-1))


def _multiply(
    inverse: Float[Array, "1 Z Z"], hp: Float[Array, "Z D"], nu: Float[Array, "1 Z"]
) -> tuple[Float[Array, "Z D"], Float[Array, "Z"]]:
    """The whitened L⁻¹ H P and L⁻¹ ν of one measurement, by L⁻¹."""
    return whiten_by(inverse, hp[None])[0], whiten_by(inverse, nu[:, :, None]).reshape(-1)


def _substitute(
    factor: Float[Array, "KK"], hp: Float[Array, "K D"], nu: Float[Array, "K"]
) -> tuple[Float[Array, "K D"], Float[Array, "K"]]:
    """The whitened L⁻¹ H P and L⁻¹ ν by substitution."""
    factor = factor.reshape(len(nu), len(nu))
    both = linalg.solve_lower(factor, jnp.concatenate([hp, nu[:, None]], axis=1))
    return both[:, :-1], both[:, -1]


@linalg.rematerialize
def whiten_by(inverse: Float[Array, "m Z Z"], rhs: Float[Array, "m Z k"]) -> Float[Array, "m Z k"]:
    """The product L⁻¹ B of each measurement, as a sum of Z outer products."""
    return linalg.total(inverse[:, :, k, None] * rhs[:, k, None] for k in range(inverse.shape[1]))
