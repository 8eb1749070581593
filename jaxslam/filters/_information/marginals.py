"""Means and covariances of a `SparseState`: recovered means, Markov blankets, the whole map.

Means are recovered by coordinate descent on ½ eᵀ Ω e - ρᵀ e, block by block. A block is solved for
its error δ; its mean moves by δ, its residual becomes zero, and those of linked landmarks change:
ρ_j ← ρ_j - Ω_ji δ_i. Ω and ξ = Ω μ + ρ do not change.

The inverse of a block of Ω is the covariance of its variables given all others; it is at most the
marginal covariance. With the Markov blanket of a variable (all that it is linked to) in the block,
the inverse is near the marginal if the uncertainty of the neighbourhood is small, and far below it
where a whole map has drifted, since the other variables are fixed at their means. A wider blanket
only delays this. For consistency take `whole_marginals`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load where they are used
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters._information import canonical
from jaxslam.filters._information.sparse_state import (
    SparseState,
    active_residual,
    landmark_blocks,
    with_active_residual,
)
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import materialize


def _move_landmarks(
    state: SparseState, slot: Int[Array, "B"], step: Float[Array, "B 2"]
) -> SparseState:
    """The state with the means of landmarks moved, and the residuals of linked ones updated."""
    n = state.alive.shape[0]
    row = state.neighbours.at[slot].get(mode="fill", fill_value=n)
    links = state.links.at[slot].get(mode="fill", fill_value=0)
    # A later write to the lists depends on the slots, so it comes after this without a copy.
    row, links, active = materialize((row, links, state.active))
    # Ω_ji δ_i for each neighbour j, and Ω_ji = Ω_ijᵀ.
    change = jnp.einsum("mkij,mi->mkj", links, step).reshape(-1, 2)
    return state._replace(
        active=active,
        landmarks=state.landmarks.at[slot].add(step, mode="drop"),
        landmark_residual=state.landmark_residual.at[row.reshape(-1)].add(-change, mode="drop"),
    )


def recover_passive_means(state: SparseState, count: int) -> SparseState:
    """The state with the passive means among the next `count` landmarks recovered in turn."""
    n = state.alive.shape[0]

    def recover(state: SparseState, i: Array) -> tuple[SparseState, None]:
        slot = (state.next_recovered + i) % n
        step, positive = linalg.solve_psd(state.diagonal[slot], state.landmark_residual[slot])
        on = state.alive[slot] & positive & ~(state.active == slot).any()
        step = jnp.where(on, step, 0.0)
        state = _move_landmarks(state, slot[None], step[None])
        left = state.landmark_residual.at[jnp.where(on, slot, n)].set(0.0, mode="drop")
        return state._replace(landmark_residual=left), None

    state, _ = jax.lax.scan(recover, state, jnp.arange(count, dtype=state.next_recovered.dtype))
    return state._replace(next_recovered=((state.next_recovered + count) % n).astype(jnp.int32))


def recover_active_means(
    state: SparseState,
    omega: Float[Array, "D D"],
    residual: Float[Array, "D"],
    omega_positive: Bool[Array, ""],
) -> tuple[SparseState, Bool[Array, ""]]:
    """The state with robot and active landmarks moved by Ω⁻¹ ρ, and whether it was solved for.

    If not (`canonical.mean_error`), means and ρ stay as they are. Ω of the state does not change.
    """
    error, solved = canonical.mean_error(omega, residual, omega_positive)
    state = with_active_residual(state, jnp.where(solved, 0.0, active_residual(state)))
    state = state._replace(pose=canonical.correct_pose(state.pose, error[:3]))
    return _move_landmarks(state, state.active, error[3:].reshape(-1, 2)), solved


def repeat_recovery(
    state: SparseState,
    omega: Float[Array, "D D"],
    solved: Bool[Array, ""],
    recovered: int,
    sweeps: int,
) -> SparseState:
    """The state after the rounds of mean recovery that follow the first: passive landmarks, then
    the active block."""
    for _ in range(sweeps - 1):
        state = recover_passive_means(state, recovered)
        state, _ = recover_active_means(state, omega, active_residual(state), solved)
    return state


def local_information(state: SparseState, slot: Int[Array, "B"]) -> Float[Array, "D D"]:
    """The information Ω of the robot and these slots, D = 3 + 2B; slot N for none, no slot twice.

    A block of two active landmarks comes from the dense block, any other one from the lists.
    """
    n, count = state.alive.shape[0], slot.shape[0]
    present = slot < n
    rows = state.neighbours.at[slot].get(mode="fill", fill_value=n)
    links = state.links.at[slot].get(mode="fill", fill_value=0)
    # (B, K, B): which of the slots each entry of a list names; links to others drop out.
    match = (rows[:, :, None] == slot[None, None, :]) & present[None, None, :]
    blocks = jnp.einsum("bkij,bkc->bcij", links, match.astype(links.dtype))
    at = (slot[:, None] == state.active[None, :]) & present[:, None]
    active, index = at.any(axis=1), jnp.argmax(at, axis=1)
    both = active[:, None] & active[None, :]
    dense = landmark_blocks(state.omega)[index][:, index]
    blocks = blocks + jnp.where(both[:, :, None, None], dense, 0.0)
    passive = state.diagonal.at[slot].get(mode="fill", fill_value=0)
    passive = jnp.where(present[:, None, None], passive, jnp.eye(2, dtype=passive.dtype)[None])
    k = jnp.arange(count)
    blocks = blocks.at[k, k].add(jnp.where(active[:, None, None], 0.0, passive))
    robot = state.omega[:3, 3:].reshape(3, -1, 2)[:, index]
    robot = jnp.where(active[None, :, None], robot, 0.0).reshape(3, 2 * count)
    # From (landmark, landmark, parameter, parameter) to rows and columns.
    flat = blocks.transpose(0, 2, 1, 3).reshape(2 * count, 2 * count)
    top = jnp.concatenate([state.omega[:3, :3], robot], axis=1)
    return jnp.concatenate([top, jnp.concatenate([robot.T, flat], axis=1)])


def blanket_cov(state: SparseState, slot: Int[Array, ""]) -> Float[Array, "5 5"]:
    """The covariance of the robot and a slot, given all landmarks outside their Markov blankets.

    The blankets are the active landmarks and the landmark's list: a matrix of 3 + 2(1 + A + K)
    rows is factored, for any N.
    """
    n = state.alive.shape[0]
    row = state.neighbours[slot]
    listed = (state.active[:, None] == row[None, :]).any(axis=1) | (state.active == slot)
    members = jnp.concatenate([slot[None], row, jnp.where(listed, n, state.active)])
    omega = local_information(state, members)
    eye = jnp.eye(omega.shape[0], 5, dtype=omega.dtype)
    return linalg.symmetrize(linalg.solve_psd(omega, eye)[0][:5])


def blanket_marginals(state: SparseState) -> tuple[Float[Array, "3 3"], Float[Array, "N 2 2"]]:
    """Covariances of the robot and of each landmark, given all outside their Markov blankets."""
    omega = state.omega
    eye = jnp.eye(omega.shape[0], 3, dtype=omega.dtype)
    pose_cov = linalg.symmetrize(linalg.solve_psd(omega, eye)[0][:3])
    slots = jnp.arange(state.alive.shape[0], dtype=jnp.int32)
    return pose_cov, jax.lax.map(lambda slot: blanket_cov(state, slot)[3:, 3:], slots)


def whole_marginals(state: SparseState) -> tuple[Float[Array, "3 3"], Float[Array, "N 2 2"]]:
    """Covariances of the robot and of each landmark by inverting the whole Ω, O(N³)."""
    count = state.alive.shape[0]
    omega = local_information(state, jnp.arange(count, dtype=jnp.int32))
    cov = linalg.inverse_psd(omega)
    k = jnp.arange(count)
    # (N, 2, N, 2), its diagonal blocks.
    points = cov[3:, 3:].reshape(count, 2, count, 2)[k, :, k]
    return cov[:3, :3], points


def whole_information(state: SparseState) -> "scipy.sparse.csc_array":
    """The whole Ω (3 + 2N, 3 + 2N), of robot and all N landmarks; not traceable."""
    active = np.asarray(state.active)
    n, index = len(state.alive), np.flatnonzero(active < len(state.alive))
    slot, passive = active[index], np.setdiff1d(np.arange(n), active)
    rows, columns, values = [], [], []

    def add(first: np.ndarray, second: np.ndarray, blocks: np.ndarray) -> None:
        """Add blocks (m, 2, 2) at landmarks first (m,), second (m,)."""
        i = 3 + 2 * first[:, None, None] + np.arange(2)[None, :, None]
        j = 3 + 2 * second[:, None, None] + np.arange(2)[None, None, :]
        rows.append(np.broadcast_to(i, blocks.shape).ravel())
        columns.append(np.broadcast_to(j, blocks.shape).ravel())
        values.append(blocks.ravel())

    add(passive, passive, np.asarray(state.diagonal)[passive])
    neighbours = np.asarray(state.neighbours)
    first, column = np.nonzero(neighbours < n)
    add(first, neighbours[first, column], np.asarray(state.links)[first, column])
    dense = np.asarray(landmark_blocks(state.omega))[index][:, index]
    first, second = (m.ravel() for m in np.meshgrid(slot, slot, indexing="ij"))
    add(first, second, dense.reshape(-1, 2, 2))
    # The robot's rows and columns: its block, and its links to the active landmarks.
    own_rows, linked = (3 + (2 * k[:, None] + np.arange(2)).ravel() for k in (slot, index))
    i, j = (
        m.ravel()
        for m in np.meshgrid(np.arange(3), np.concatenate([np.arange(3), own_rows]), indexing="ij")
    )
    top = np.asarray(state.omega)[:3][:, np.concatenate([np.arange(3), linked])].ravel()
    beside = j >= 3
    rows += [i, j[beside]]
    columns += [j, i[beside]]
    values += [top, top[beside]]
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.coo_array(entries, shape=(3 + 2 * n, 3 + 2 * n)).tocsc()
