"""Mean recovery in a `SparseState`: coordinate descent on ½ eᵀ Ω e - ρᵀ e, block by block.

A block is solved for its error δ; its mean moves by δ, its residual becomes zero, and those of
linked landmarks change: ρ_j ← ρ_j - Ω_ji δ_i. Ω and ξ = Ω μ + ρ do not change.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.information import canonical
from jaxslam.filters.information.sparse.sparse_state import (
    SparseState,
    active_residual,
    with_active_residual,
)
from jaxslam.math import linalg
from jaxslam.math.xla import materialize


def move_landmarks(
    state: SparseState, slot: Int[Array, "B"], step: Float[Array, "B 2"]
) -> SparseState:
    """The state with the means of landmarks moved, and the residuals of linked ones updated."""
    n = state.alive.shape[0]
    row = state.neighbours.at[slot].get(mode="fill", fill_value=n)
    links = state.links.at[slot].get(mode="fill", fill_value=0)
    # A later write to the lists depends on the slots, so it comes after this without a copy.
    row, links, active = materialize((row, links, state.active))
    change = jnp.einsum("mkij,mi->mkj", links, step).reshape(-1, 2)
    return state._replace(
        active=active,
        landmarks=state.landmarks.at[slot].add(step, mode="drop"),
        landmark_residual=state.landmark_residual.at[row.reshape(-1)].add(-change, mode="drop"),
    )


def recover_passive_means(state: SparseState, count: int) -> SparseState:
    """The state with the passive means among the next `count` landmarks recovered in turn."""
    n = state.alive.shape[0]

    def recover_one(state: SparseState, i: Array) -> tuple[SparseState, None]:
        slot = (state.next_recovered + i) % n
        step, positive = linalg.solve_psd(state.diagonal[slot], state.landmark_residual[slot])
        on = state.alive[slot] & positive & ~(state.active == slot).any()
        step = jnp.where(on, step, 0.0)
        state = move_landmarks(state, slot[None], step[None])
        left = state.landmark_residual.at[jnp.where(on, slot, n)].set(0.0, mode="drop")
        return state._replace(landmark_residual=left), None

    state, _ = jax.lax.scan(recover_one, state, jnp.arange(count))
    return state._replace(next_recovered=((state.next_recovered + count) % n).astype(jnp.int32))


def recover_active_means(
    state: SparseState,
    omega: Float[Array, "D D"],
    residual: Float[Array, "D"],
    omega_positive: Bool[Array, ""],
) -> tuple[SparseState, Bool[Array, ""]]:
    """Robot and active landmarks moved by Ω⁻¹ ρ, and whether that could be solved for.

    Where it could not (`canonical.mean_error`), means and ρ do not change. Ω of the state is not
    changed.
    """
    error, solved = canonical.mean_error(omega, residual, omega_positive)
    state = with_active_residual(state, jnp.where(solved, 0.0, active_residual(state)))
    state = state._replace(pose=canonical.correct_pose(state.pose, error[:3]))
    return move_landmarks(state, state.active, error[3:].reshape(-1, 2)), solved


def repeat_recovery(
    state: SparseState,
    omega: Float[Array, "D D"],
    solved: Bool[Array, ""],
    recovered: int,
    sweeps: int,
) -> SparseState:
    """Mean recovery, the rounds after the first: passive landmarks, then the active block."""
    for _ in range(sweeps - 1):
        state = recover_passive_means(state, recovered)
        state, _ = recover_active_means(state, omega, active_residual(state), solved)
    return state
