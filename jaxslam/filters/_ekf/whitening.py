"""The products and factors of a correction: H P, S = H P Hᵀ + R = L Lᵀ, and what L⁻¹ whitens.

m measurements of Z numbers are rows (m, Z) of one vector ν of mZ = m·Z numbers; a measurement
involves the robot and one landmark, so H has B = R + L columns a measurement, and no D×D product is
formed.

Why some lines are called by `no_inline` or stored by `materialize` (`math._xla`): XLA on a CPU
fuses a cheap producer into each of its consumers and computes it again there. What each of the D²
entries of P - Vᵀ V needs is therefore computed once and stored, here or where these functions are
called.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core.slots import Joint
from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import log_det_of_pivots
from jaxslam.math._xla import materialize, no_inline


class Projection(NamedTuple):
    """What H of m measurements makes of P: H P and S = H P Hᵀ + R, Solà (27); and their ν."""

    nu: Float[Array, "m Z"]
    """ν"""
    hp: Float[Array, "mZ D"]
    """H P"""
    hx: Float[Array, "mZ D"]
    """H X of a square-root filter, P = X Xᵀ; else H P"""
    s: Float[Array, "m Z m Z"]
    """S"""
    s_ii: Float[Array, "m Z Z"]
    """its diagonal block of each measurement"""
    inverse: Float[Array, "m Z Z"]
    """L_ii⁻¹ of S_ii = L_ii L_iiᵀ"""
    definite: Bool[Array, "m"]
    """S_ii is positive definite"""


def project_cov(
    joint: Joint,
    landmark_rows: Float[Array, "m L D"],
    slot: Int[Array, "m"],
    h: tuple[Float[Array, "m Z R"], Float[Array, "m Z L"]],
    nu: Float[Array, "m Z"],
    noise: Float[Array, "m Z Z"],
    *,
    square_root: bool,
) -> Projection:
    """The `Projection` of P, or of its root X, by H = (by robot, by landmark), with noise R.

    landmark_rows: the rows of P, or X, of the landmarks in slot (m,). ν is stored with H.
    """
    (m, size_z), n = nu.shape, joint.robot_size
    # One array, and so one kernel and not three.
    h_nu = materialize(jnp.concatenate([*h, nu[:, :, None]], axis=2))
    by_pose, by_landmark, nu = h_nu[:, :, :n], h_nu[:, :, n:-1], h_nu[:, :, -1]
    # mZ·D entries, each of which P - Vᵀ V needs D times.
    hp = hx = no_inline(project, h_nu, joint.cov[:n], landmark_rows)
    if square_root:
        # Of a root X only H X is at hand: H P = (H X) Xᵀ, O(D²) a row.
        hp = materialize((hx.reshape(m * size_z, -1) @ joint.cov.T).reshape(hx.shape))
    s = projected_cov(hp, by_pose, by_landmark, slot, len(joint.landmarks))
    # (m, 1, m, 1) times R: diagonal blocks.
    s = s + jnp.eye(m, dtype=noise.dtype)[:, None, :, None] * noise[:, :, None]
    # (m, Z, Z): index arrays on both sides of a slice put their axis first.
    s_ii = s[jnp.arange(m), :, jnp.arange(m)]
    # Stored: each of the D columns of L⁻¹ H P needs it.
    inverse, definite = no_inline(jax.vmap(linalg.whitener), s_ii)
    hp, hx = (rows.reshape(m * size_z, -1) for rows in (hp, hx))
    return Projection(nu, hp, hx, s, s_ii, inverse, definite)


@linalg.rematerialize
def project(
    h_nu: Float[Array, "m Z B1"], robot: Float[Array, "R D"], landmark: Float[Array, "m L D"]
) -> Float[Array, "m Z D"]:
    """The product H P (m, Z, D) of H, the first B columns of h_nu, with the rows of P it involves.

    Written as a sum of R + L outer products, which XLA vectorizes over D; a batched matrix product
    of such thin matrices is a library call for each.
    """
    n = len(robot)
    terms = [h_nu[:, :, k, None] * robot[None, None, k] for k in range(n)]
    terms += [h_nu[:, :, n + k, None] * landmark[:, None, k] for k in range(landmark.shape[1])]
    return linalg.total(terms)


def projected_cov(
    hp: Float[Array, "m Z D"],
    by_pose: Float[Array, "m Z R"],
    by_landmark: Float[Array, "m Z L"],
    slot: Int[Array, "m"],
    capacity: int,
) -> Float[Array, "m Z m Z"]:
    """The covariance H P Hᵀ of predicted measurements, from the columns of H P that H meets."""
    (m, size_z, size_l), n = by_landmark.shape, by_pose.shape[2]
    # Axes: measurement and entry of the first, measurement and entry of the second.
    cov = linalg.total(hp[:, :, k, None, None] * by_pose[None, None, :, :, k] for k in range(n))
    if size_l == 0:
        return cov
    # Columns of H P by landmark: measurement and entry, then slot and entry (m, Z, N, L); of these
    # the landmark of each measurement, (m, Z, m, L).
    by_slot = hp[:, :, n : n + capacity * size_l].reshape(m, size_z, capacity, size_l)
    at_landmark = by_slot[:, :, slot]
    return cov + linalg.total(
        at_landmark[..., k, None] * by_landmark[None, None, :, :, k] for k in range(size_l)
    )


class Whitened(NamedTuple):
    """What L⁻¹ of S = L Lᵀ, the S of the fused measurements, makes of H P and ν."""

    s: Float[Array, "m Z m Z"]
    """S; the identity for measurements that are not fused"""
    factor: Float[Array, "mZ mZ"]
    """L; rows of zeros for measurements that are not fused"""
    log_det: Float[Array, "m"]
    """log |S_ii| given the measurements before it"""
    regular: Bool[Array, "m"]
    """the measurement's pivots of L are positive"""
    v: Float[Array, "mZ D"]
    """V = L⁻¹ H P; rows of zeros for measurements that are not fused"""
    nu: Float[Array, "mZ"]
    """L⁻¹ ν; zeros for measurements that are not fused"""
    xi: Float[Array, "D"]
    """the correction ξ = K ν = Vᵀ L⁻¹ ν in the chart"""


def whiten(projection: Projection, fuse: Bool[Array, "m"]) -> Whitened:
    """The whitened rows and innovations of the measurements that are fused, and their correction.

    fuse: matched, inside the gate, and with a positive definite S_ii.
    """
    nu, hp, definite = projection.nu, projection.hp, projection.definite
    m, size_z = nu.shape
    diagonal = jnp.eye(m, dtype=hp.dtype)[:, None, :, None]  # (m, 1, m, 1)
    both = fuse[:, None, None, None] & fuse[None, None, :, None]
    # The identity where not fused, apart from all others: then S is regular if its fused part is.
    unit = jnp.eye(size_z, dtype=hp.dtype)
    s = materialize(jnp.where(both, projection.s, diagonal * unit[None, :, None]))
    # (m, Z, m, Z) -> (mZ, mZ): row i·Z + j is entry j of measurement i.
    factor = materialize(linalg.cholesky(s.reshape(m * size_z, m * size_z))[0])
    pivots = jnp.diagonal(factor).reshape(m, size_z)
    # Measurements that are regular one by one can still be singular together.
    regular = definite if m == 1 else (pivots > 0).all(axis=1)
    used = fuse & regular
    # A row without a pivot is zero and so has no effect, without a mask.
    factor = jnp.where(jnp.repeat(used, size_z)[:, None], factor, 0.0)
    if m == 1:  # S is S_ii, whose L⁻¹ is at hand: the pivots of L need not be computed
        # The pivots of L⁻¹ are one over those of L, so the sign turns.
        log_det = -log_det_of_pivots(jnp.diagonal(projection.inverse, axis1=1, axis2=2))
        inverse = jnp.where(used[:, None, None], projection.inverse, 0.0)
        v, whitened_nu = no_inline(_multiply, inverse, hp, nu)
    else:
        log_det = log_det_of_pivots(pivots)
        # As a vector, the factor has one layout: LAPACK wants columns, and XLA (jaxlib 0.12) may
        # pass rows to a computation that was compiled for columns.
        v, whitened_nu = no_inline(_substitute, factor.reshape(-1), hp, nu.reshape(-1))
    xi = linalg.gram(v, whitened_nu[:, None])[:, 0]
    return Whitened(s, factor, log_det, regular, v, whitened_nu, xi)


def _multiply(
    inverse: Float[Array, "1 Z Z"], hp: Float[Array, "Z D"], nu: Float[Array, "1 Z"]
) -> tuple[Float[Array, "Z D"], Float[Array, "Z"]]:
    """The whitened L⁻¹ H P and L⁻¹ ν of one measurement, by L⁻¹."""
    return whiten_by(inverse, hp[None])[0], whiten_by(inverse, nu[:, :, None]).reshape(-1)


def _substitute(
    factor: Float[Array, "mZ_squared"], hp: Float[Array, "mZ D"], nu: Float[Array, "mZ"]
) -> tuple[Float[Array, "mZ D"], Float[Array, "mZ"]]:
    """The whitened L⁻¹ H P and L⁻¹ ν by substitution."""
    factor = factor.reshape(len(nu), len(nu))
    both = linalg.solve_lower(factor, jnp.concatenate([hp, nu[:, None]], axis=1))
    return both[:, :-1], both[:, -1]


@linalg.rematerialize
def whiten_by(inverse: Float[Array, "m Z Z"], rhs: Float[Array, "m Z k"]) -> Float[Array, "m Z k"]:
    """The product L⁻¹ B of each measurement, as a sum of Z outer products."""
    return linalg.total(inverse[:, :, k, None] * rhs[:, k, None] for k in range(inverse.shape[1]))
