"""Relocation of the robot in `eseif`, which replaces sparsification: the pose is estimated anew.

With z_β the scan's measurements of active landmarks, the pose is marginalized out of the active
block, and estimated from z_β alone:

    Ω_m ← Ω_mm - Ω_mx Ω_xx⁻¹ Ω_xm,   ρ_m ← ρ_m - Ω_mx Ω_xx⁻¹ ρ_x,   all of the robot's rows ← 0,
    Ω ← Ω + H_βᵀ R⁻¹ H_β,            ρ ← ρ + H_βᵀ R⁻¹ ν_β.

The odometry between the map and z_β is discarded, so Ω contains no more information than before.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxslam.filters.information import canonical, innovation
from jaxslam.filters.information.innovation import CanonicalInnovations
from jaxslam.filters.information.settings import RelocationSettings
from jaxslam.filters.information.sparse.mean_recovery import recover_active_means
from jaxslam.filters.information.sparse.sparse_state import (
    SparseState,
    active_means,
    active_residual,
    linked_to_robot,
)
from jaxslam.filters.information.tag_association import TagAssociation
from jaxslam.math import linalg
from jaxslam.math.gaussians import log_det_of
from jaxslam.math.xla import where_any
from jaxslam.types import Scan


def relocate_or_correct(
    settings: RelocationSettings,
    state: SparseState,
    scan: Scan,
    measured: TagAssociation,
    matches: Bool[Array, "M A"],
) -> tuple[SparseState, CanonicalInnovations, Bool[Array, ""]]:
    """The state corrected by z_β, relocated or not, and whether its mean could be solved for.

    The robot is relocated where free indices of the active set run out (`runs_out`) and z_β
    determines a pose (`determines_pose`).
    """
    of_active = measured.known & matches.any(axis=1)
    index = jnp.argmax(matches, axis=1)
    innovations = innovation.innovations(
        settings, state.omega, state.pose, active_means(state), scan, index, of_active
    )
    relocate = runs_out(settings, state, measured, matches) & determines_pose(
        innovations.whitened_jacobian[:, :3], settings.turn
    )
    residual = active_residual(state)
    without, residual_without = marginalize_pose(state.omega, residual)
    full, _ = canonical.measurement_update(state.omega, residual, innovations)
    omega, residual = canonical.measurement_update(
        jnp.where(relocate, without, state.omega),
        jnp.where(relocate, residual_without, residual),
        innovations,
    )
    linked_before = linked_to_robot(state.omega)
    state, solved = recover_active_means(state, omega, residual, innovations.omega_positive)
    relocated = relocate & solved
    nats = where_any(
        relocate,
        lambda pair: jnp.maximum(0.5 * (_log_det(pair[0]) - _log_det(pair[1])), 0.0),
        lambda pair: jnp.zeros((), pair[0].dtype),
        (full, omega),
    )
    lost = relocated & linked_before & ~linked_to_robot(omega)
    counts = state.counts._replace(
        relocated=state.counts.relocated + relocated.astype(jnp.int32),
        cut=state.counts.cut + lost.sum(dtype=jnp.int32),
        cut_nats=state.counts.cut_nats + jnp.where(relocated, nats, 0.0),
    )
    state = state._replace(omega=jnp.where(solved, omega, state.omega), counts=counts)
    return state, innovation.refuse_unless(solved, innovations), solved


def runs_out(
    settings: RelocationSettings,
    state: SparseState,
    measured: TagAssociation,
    matches: Bool[Array, "M A"],
) -> Bool[Array, ""]:
    """Whether the scan needs more indices of the active set than are free, minus a reserve.

    An index is free if it is empty, or if its landmark is not linked to the robot and not measured
    now; and a relocation must free some.
    """
    measurements, size = matches.shape
    enters = measured.has_slot & ~matches.any(axis=1)
    linked, in_scan = linked_to_robot(state.omega), matches.any(axis=0)
    free = ((state.active >= settings.capacity) | ~(linked | in_scan)).sum()
    beyond = size - min(measurements, size)
    reserve = max(min(measurements, beyond), beyond // 2)
    reserve = min(reserve, settings.capacity - size)  # no more are ever needed
    return (enters.sum() > free - reserve) & (linked & ~in_scan).any()


def marginalize_pose(
    omega: Float[Array, "D D"], residual: Float[Array, "D"]
) -> tuple[Float[Array, "D D"], Float[Array, "D"]]:
    """The information Ω and ρ after the robot's pose is marginalized out, its rows then zero."""
    factor = linalg.cholesky(omega[:3, :3])[0]
    half = linalg.solve_lower(factor, omega[:3])
    rest = jnp.arange(len(residual)) >= 3
    less = linalg.symmetrize(omega - half.T @ half)
    left = residual - half.T @ linalg.solve_lower(factor, residual[:3])
    return jnp.where(rest[:, None] & rest[None, :], less, 0.0), jnp.where(rest, left, 0.0)


def determines_pose(rows: Float[Array, "MZ 3"], turn: float) -> Bool[Array, ""]:
    """Whether measurements of known landmarks determine the whole pose.

    rows: their whitened Jacobians by the pose, J = rowsᵀ rows. All of J's pivots at unit
    diagonal are above √eps, and the heading's standard deviation, of J⁻¹, is at most turn [rad].
    """
    information = rows.T @ rows
    size = jnp.diagonal(information)
    there = (size > 0).all()
    scale = jnp.where(there, jnp.sqrt(jnp.where(size > 0, size, 1.0)), 1.0)
    unit = jnp.where(there, information / scale[:, None] / scale[None, :], jnp.eye(3))
    factor, positive = linalg.cholesky(unit)
    pivot = jnp.diagonal(factor)
    rank = (pivot**2 > float(jnp.finfo(rows.dtype).eps) ** 0.5).all()
    # The heading comes last: the square of its pivot is its marginal information.
    spread = 1.0 / (jnp.where(rank, pivot[2], 1.0) * scale[2])
    determined: Array = there & positive & rank & (spread <= turn)
    return determined


def _log_det(omega: Float[Array, "D D"]) -> Float[Array, ""]:
    return log_det_of(linalg.cholesky(omega)[0])
