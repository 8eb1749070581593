"""The second step: hypotheses are confirmed and corrected, or contradicted, by new measurements."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core.slots import Joint
from jaxslam.filters._delayed.delayed_filter import DelayedFilter
from jaxslam.filters._delayed.hypotheses import noise_of, point_residuals
from jaxslam.filters._delayed.state import (
    SIZE,
    DelayedState,
    NewMeasurements,
    TableLayout,
    add_to,
    covariance_rows,
    delete_slots_if_any,
    slots_where,
)
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import materialize


def confirm_hypotheses(
    filter: DelayedFilter,
    state: DelayedState,
    new: NewMeasurements,
    slot: Int[Array, "M"],
    stored: Bool[Array, "M"],
) -> tuple[DelayedState, Bool[Array, "M"], Int[Array, "C"]]:
    """The state with hypotheses confirmed and corrected, or deleted.

    Each hypothesis is compared with the stored measurements of its tag; the least g²/var(g)
    confirms it, if that is within the gate.

    Args:
        slot: slots of the measurements in the table.
        stored: mask of the measurements in the table.
    Returns:
        The state; the mask of the measurements within the gate of a hypothesis; and the
        measurement that confirmed each hypothesis, -1 for none.
    """
    layout, joint = filter.layout, state.joint
    alive, tag = joint.alive[layout.of_hypotheses], joint.tag[layout.of_hypotheses]
    compared = alive[:, None] & stored[None, :] & (tag[:, None] == new.tag[None, :])
    residuals = point_residuals(joint, filter.triangulation, layout.hypothesis_slots, slot)
    change = jax.vmap(noise_of(filter, state, slot).change)(residuals.value)
    residuals = residuals._replace(variance=residuals.variance + change)
    squared = jnp.where(compared, residuals.squared_distance(), jnp.inf)
    within = squared <= filter.gamma
    best = jnp.argmin(squared, axis=1)
    c = jnp.arange(layout.hypotheses)
    confirmed = within[c, best]
    constraints = constraints_of(
        joint,
        layout.hypothesis_slots,
        slot[best],
        residuals.value[c, best],
        residuals.by_point[c, best],
        residuals.by_stored[c, best],
        change[c, best],
    )
    joint = correct_hypotheses(joint, layout, constraints, confirmed)

    contradicted = compared.any(axis=1) & ~confirmed
    lost = jnp.where(
        contradicted, jnp.asarray(filter.hypotheses.decay, state.persistence.dtype), 0.0
    )
    persistence = state.persistence + jnp.where(confirmed, 1.0, 0.0) - lost
    confirmed_at = jnp.where(confirmed, state.clock, state.confirmed_at)
    # Without a new measurement a hypothesis had no chance to be confirmed.
    stale = (state.clock - confirmed_at > filter.hypotheses.patience) & new.wanted.any()
    vanished = alive & ((persistence <= 0) | stale)
    state = state._replace(
        joint=joint,
        persistence=persistence,
        confirmed_at=confirmed_at,
        counts=state.counts._replace(vanished=add_to(state.counts.vanished, vanished)),
    )
    state = delete_slots_if_any(layout, state, slots_where(layout, hypotheses=vanished))
    return state, within.any(axis=0), jnp.where(confirmed & ~vanished, best, -1)


class _Constraints(NamedTuple):
    """m constraints g = 0, each between one point and one stored measurement; H = ∂g."""

    value: Float[Array, "m"]
    """g"""
    hp: Float[Array, "m D"]
    """H P"""
    cov: Float[Array, "m m"]
    """H P Hᵀ"""
    variance: Float[Array, "m"]
    """its diagonal with R(ẑ), by which each is weighted"""


def constraints_of(
    joint: Joint,
    points: Int[Array, "m"],
    stored: Int[Array, "m"],
    value: Float[Array, "m"],
    by_point: Float[Array, "m 2"],
    by_stored: Float[Array, "m 3"],
    change: Float[Array, "m"],
) -> _Constraints:
    """The constraints between m points and m stored measurements, by their slots.

    change: R(ẑ) - R(z) of each.
    """
    by_point = jnp.pad(by_point, [(0, 0), (0, SIZE - 2)])
    rows = covariance_rows(joint)
    hp = jnp.einsum("mi,mid->md", by_point, rows[points])
    hp = hp + jnp.einsum("mi,mid->md", by_stored, rows[stored])
    columns = hp[:, 3:].reshape(len(points), -1, SIZE)
    cov = jnp.einsum("mni,ni->mn", columns[:, points], by_point)
    cov = cov + jnp.einsum("mni,ni->mn", columns[:, stored], by_stored)
    cov = linalg.symmetrize(cov)
    return materialize(_Constraints(value, hp, cov, jnp.diagonal(cov) + change))


def correct_hypotheses(
    joint: Joint, layout: TableLayout, constraints: _Constraints, confirmed: Bool[Array, "C"]
) -> Joint:
    """The joint with each confirmed hypothesis corrected by its constraint, and nothing else.

    g = 0 is a measurement without noise (the noise of the stored measurement is in P). A
    hypothesis may be false, so of the optimal gain K = P Hᵀ/S only the rows of the hypothesis are
    kept (Schmidt 1966, "Application of state-space methods to navigation problems": variables that
    are considered, not estimated). Of any gain, P ← (I - KH) P (I - KH)ᵀ is the error's covariance:

        x ← x - K g,  P ← P - K HP - (K HP)ᵀ + K S Kᵀ,  S = H P Hᵀ

    also of the gain with R(ẑ), while P has R(z),

    and the covariances of robot, landmarks and stored measurements do not change.
    """
    count, hypothesis_rows = layout.hypotheses, layout.hypothesis_rows
    rows = SIZE * count
    c = jnp.arange(count)
    # Column block c of row c: the covariance of constraint c with hypothesis c, P Hᵀ.
    ph = constraints.hp[:, hypothesis_rows].reshape(count, count, SIZE)[c, c]
    variance = constraints.variance
    used = confirmed & (variance > 0)
    gain = jnp.where(used[:, None], ph / jnp.where(used, variance, 1.0)[:, None], 0.0)
    k_hp = (gain[:, :, None] * constraints.hp[:, None, :]).reshape(rows, -1)
    # Axes (hypothesis, parameter, hypothesis, parameter).
    k_s_k = gain[:, :, None, None] * constraints.cov[:, None, :, None] * gain[None, None]
    # Added to the rows and, transposed, to the columns: half of K S Kᵀ each.
    half = -k_hp.at[:, hypothesis_rows].add(-0.5 * k_s_k.reshape(rows, rows))
    # Stored before it is transposed; otherwise each entry would be computed twice.
    half = materialize(half)
    return joint._replace(
        landmarks=joint.landmarks.at[layout.of_hypotheses].add(-gain * constraints.value[:, None]),
        cov=joint.cov.at[hypothesis_rows].add(half).at[:, hypothesis_rows].add(half.T),
    )
