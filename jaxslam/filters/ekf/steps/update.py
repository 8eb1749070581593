"""The correction of a Kalman-type SLAM filter by measurements at once.

As in `predict`, the sparsity of the models is used (a motion involves the robot alone, a
measurement the robot and one landmark): no dense D×D product is formed. The models are records of
the settings, so one set of equations serves every sensor, chart and linearizer.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.filters.ekf.coordinates.map_coordinates import retracted
from jaxslam.filters.ekf.settings import Covariance, EkfSettings
from jaxslam.filters.ekf.steps.innovation import (
    Correction,
    Innovation,
    innovate,
    view_of,
)
from jaxslam.math import linalg
from jaxslam.math.xla import materialize
from jaxslam.protocols import Chart
from jaxslam.slots import Joint


def correct(
    joint: Joint,
    z: Float[Array, "m Z"],
    slot: Int[Array, "m"],
    known: Bool[Array, "m"],
    settings: EkfSettings,
) -> tuple[Joint, Correction]:
    """The joint corrected by m measurements z (m, Z) of landmarks in slot (m,): Solà (26)-(30).

    With S = H P Hᵀ + R = L Lᵀ and V = L⁻¹ H P: x ← x ⊞ Vᵀ L⁻¹ ν and P ← P - Vᵀ V, symmetric as it
    stands. H is Z×(3+L) a measurement; where L = 0 (an absolute sensor) slot is not used.
    Measurements not known (m,), outside the gate (ν_iᵀ S_ii⁻¹ ν_i above it, each against the prior)
    or with a singular S have no effect.

    Each further iteration linearizes at the newest estimate x_i = x ⊞ ξ_i but starts again from the
    prior: ξ_{i+1} = K (z - h(x_i) + H ξ_i) (Bell & Cathey 1993).

    Other forms of the covariance: "joseph", P ← (I-KH)P(I-KH)ᵀ + KRKᵀ; "square_root", of P = X Xᵀ,
    X ← X - Vᵀ (L + N)⁻¹ H X, R = N Nᵀ (Andrews 1968, "A square root formulation of the Kalman
    covariance equations", AIAA Journal 6(6)).
    """
    view = view_of(joint, slot, settings.square_root)
    found = innovate(joint, slot, view, z, known, (joint, slot), settings)
    cov = _corrected_cov(joint.cov, found, settings.covariance)
    return retract_means(joint, found.xi, settings.chart)._replace(cov=cov), found.correction


def _corrected_cov(
    cov: Float[Array, "D D"], found: Innovation, form: Covariance
) -> Float[Array, "D D"]:
    """The covariance P, or its root X, after the correction."""
    v, factor, noise = found.v, found.factor, found.noise
    m, size_z = noise.shape[:2]
    if form == "plain":
        return cov - linalg.self_gram(v)
    same = jnp.eye(m, dtype=noise.dtype)[:, None, :, None]
    if form == "joseph":
        each = found.fuse[:, None, None, None]
        fused_noise = jnp.where(each, same * noise[:, :, None], 0.0)
        return _joseph(cov, found.hp, found.s, fused_noise, factor, v)
    root = jax.vmap(lambda cov: linalg.cholesky(cov)[0])(noise)
    unit = jnp.eye(size_z, dtype=noise.dtype)
    root = same * jnp.where(found.fuse[:, None, None], root, unit)[:, :, None]
    root = factor + root.reshape(m * size_z, m * size_z)
    hx = found.hx.reshape(m * size_z, -1)
    return cov - linalg.gram(v, materialize(linalg.solve_lower(root, hx)))


def retract_means(joint: Joint, xi: Float[Array, "D"], chart: Chart) -> Joint:
    """The means retracted by ξ; P is not changed."""
    pose, landmarks = retracted(chart, joint, xi)
    return joint._replace(pose=pose, landmarks=landmarks)


def _joseph(
    cov: Float[Array, "D D"],
    hp: Float[Array, "K D"],
    s: Float[Array, "m Z m Z"],
    noise: Float[Array, "m Z m Z"],
    factor: Float[Array, "K K"],
    v: Float[Array, "K D"],
) -> Float[Array, "D D"]:
    """Joseph's form (I - KH) P (I - KH)ᵀ + K R Kᵀ from H P, in O(D²): left factor, then right."""
    rows = hp.shape[0]
    gain = linalg.solve_lower(factor[::-1, ::-1].T, v[::-1])[::-1].T
    noise = noise.reshape(rows, rows)
    left = cov - gain @ hp
    left_h = hp.T - gain @ (s.reshape(rows, rows) - noise)
    return linalg.symmetrize(left - left_h @ gain.T + gain @ noise @ gain.T)
