"""The active set of a `SparseState`: its landmarks, activation and deactivation.

A landmark leaves only without a link to the robot, which `sparsification.sparsify` cuts.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int

from jaxslam import slots
from jaxslam.filters.information.sparse.link_lists import enter_link, enter_links
from jaxslam.filters.information.sparse.sparse_state import (
    SparseState,
    landmark_blocks,
    with_landmark_blocks,
)
from jaxslam.filters.information.tag_association import TagAssociation
from jaxslam.math.xla import materialize


def active_matches(state: SparseState, association: TagAssociation) -> Bool[Array, "M A"]:
    """Which measurements are of the landmark at each index of the active set."""
    same = association.slot[:, None] == state.active[None, :]
    return association.has_slot[:, None] & same


def assign_indices(
    order: Int[Array, "A"],
    rank: Int[Array, "M"],
    enters: Bool[Array, "M"],
    matches: Bool[Array, "M A"],
) -> tuple[Int[Array, "M"], Bool[Array, "A"]]:
    """The index of each measured landmark in the active set, and which indices are newly assigned.

    Landmarks that enter get the indices with the least `order`, by their `rank`; the others have
    theirs (`active_matches`).
    """
    by_order = jnp.argsort(order, stable=True)
    entered = by_order[jnp.clip(rank, 0, len(by_order) - 1)]
    index = jnp.where(enters, entered, jnp.argmax(matches, axis=1))
    return index, slots.concerned(index, enters, len(by_order))


def deactivate(
    state: SparseState, leaving: Bool[Array, "A"], most: int, conservative: bool
) -> SparseState:
    """The state with at most `most` active landmarks without robot links made passive.

    Their links to active landmarks go to the lists; a full list drops one (`link_lists`).
    """
    n, count = state.alive.shape[0], leaving.shape[0]
    omega = state.omega
    blocks = landmark_blocks(omega)
    every = jnp.arange(count)
    state = state._replace(
        diagonal=state.diagonal.at[state.active].set(blocks[every, every], mode="drop")
    )
    order = jnp.argsort(~leaving, stable=True)[:most]
    # Each pair once: of two that leave, by the one that is processed first.
    earlier = (order[:, None] == every[None, :])[None, :, :] & (
        jnp.arange(len(order))[None, :] < jnp.arange(len(order))[:, None]
    )[:, :, None]
    entered = leaving[order][:, None] & (state.active < n)[None, :] & ~earlier.any(axis=1)
    entered = entered & (order[:, None] != every[None, :])

    def enter_pair(state: SparseState, of: tuple[Array, ...]) -> tuple[SparseState, None]:
        a, b, on = of
        pair = state.active[a], state.active[b]
        return enter_link(state, *pair, blocks[a, b], on, conservative), None

    def enter_row(state: SparseState, of: tuple[Array, ...]) -> tuple[SparseState, None]:
        a, on = of
        return enter_links(state, state.active[a], state.active, blocks[a], on), None

    if state.neighbours.shape[1] >= n - 1:
        state, _ = jax.lax.scan(enter_row, state, (order, entered))
    else:
        pairs = jnp.repeat(order, count), jnp.tile(every, len(order)), entered.reshape(-1)
        state, _ = jax.lax.scan(enter_pair, state, pairs)
    own = state.diagonal.at[state.active].get(mode="fill", fill_value=0)
    unit = jnp.eye(2, dtype=omega.dtype)
    empty = leaving | (state.active >= n)
    blocks = blocks.at[every, every].set(own)
    blocks = jnp.where((leaving[:, None] | leaving[None, :])[:, :, None, None], 0.0, blocks)
    blocks = blocks.at[every, every].set(jnp.where(empty[:, None, None], unit, own))
    return state._replace(
        omega=with_landmark_blocks(omega, blocks),
        active=jnp.where(leaving, n, state.active).astype(jnp.int32),
    )


def activate(
    state: SparseState,
    index: Int[Array, "M"],
    slot: Int[Array, "M"],
    enters: Bool[Array, "M"],
) -> SparseState:
    """The state with the landmarks of these slots active at empty indices, where they enter.

    Their diagonal blocks, and their links to others that are active now, move to the dense block.
    """
    n, count = state.alive.shape[0], state.active.shape[0]
    at = jnp.where(enters, index, count)
    active = state.active.at[at].set(slot.astype(jnp.int32), mode="drop")
    entered = jnp.zeros(count, bool).at[at].set(True, mode="drop")
    rows = state.neighbours.at[active].get(mode="fill", fill_value=n)
    links = state.links.at[active].get(mode="fill", fill_value=0)
    rows, links = materialize((rows, links))
    match = (rows[:, :, None] == active[None, None, :]) & (active < n)[None, None, :]
    found = jnp.einsum("akij,akb->abij", links, match.astype(links.dtype))
    own = state.diagonal.at[jnp.where(entered, active, n)].get(mode="fill", fill_value=0)
    blocks = landmark_blocks(state.omega) + found
    every = jnp.arange(count)
    before = blocks[every, every]
    blocks = blocks.at[every, every].set(jnp.where(entered[:, None, None], own, before))
    moved = match.any(axis=2)
    left = jnp.where(moved[:, :, None, None], 0.0, links)
    return state._replace(
        active=active,
        omega=with_landmark_blocks(state.omega, blocks),
        neighbours=state.neighbours.at[active].set(jnp.where(moved, n, rows), mode="drop"),
        links=state.links.at[active].set(left, mode="drop"),
    )
