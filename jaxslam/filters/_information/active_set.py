"""The active set of a `SparseState`: its landmarks, links, activation and deactivation.

A landmark leaves only without a link to the robot, which `sparse_state.sparsify` cuts. A list of
links that is full drops its weakest one for a new one.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.filters._information.sparse_state import (
    SparseState,
    drop_link,
    landmark_blocks,
    with_landmark_blocks,
)
from jaxslam.filters._information.tag_innovation import TagAssociation
from jaxslam.math._xla import materialize


def enter_link(
    state: SparseState,
    i: Int[Array, ""],
    j: Int[Array, ""],
    link: Float[Array, "2 2"],
    on: Bool[Array, ""],
    conservative: bool = False,
) -> SparseState:
    """The state with the link Ω_ij in the lists of landmarks i and j, where on and it is not 0.

    A full list drops its weakest link (least |Ω_ij|), or the new one is not entered if that is the
    weakest: `sparse_state.drop_link`. `diagonal` must be current for both landmarks.
    """
    n = state.alive.shape[0]
    size = (link**2).sum()
    on = on & (size > 0)
    i, j = jnp.where(on, i, n), jnp.where(on, j, n)

    def weakest(of: Array) -> tuple[Array, Array, Array, Array]:
        row = state.neighbours.at[of].get(mode="fill", fill_value=n)
        links = state.links.at[of].get(mode="fill", fill_value=0)
        weight = jnp.where(row < n, (links**2).sum(axis=(1, 2)), -1.0)
        at = jnp.argmin(weight)
        return at, row[at], links[at], weight[at]

    # Read before any write; otherwise XLA copies all N lists to read them later.
    found = materialize((weakest(i), weakest(j)))
    (at_i, p, link_p, least_i), (at_j, q, link_q, least_j) = found
    keep = on & (size > least_i) & (size > least_j)
    index, links = state.neighbours, state.links
    diagonal, counts = drop_link(state.diagonal, state.counts, i, j, link, on & ~keep, conservative)
    for mine, other, old, least in ((i, p, link_p, least_i), (j, q, link_q, least_j)):
        full = keep & (least >= 0)
        diagonal, counts = drop_link(diagonal, counts, mine, other, old, full, conservative)
        row = index.at[jnp.where(full, other, n)].get(mode="fill", fill_value=n)
        back = row == mine
        gone = materialize((jnp.where(full & back.any(), other, n), jnp.argmax(back)))
        index = index.at[gone].set(n, mode="drop")
        links = links.at[gone].set(0.0, mode="drop")
    i, j = jnp.where(keep, i, n), jnp.where(keep, j, n)
    index = index.at[i, at_i].set(j.astype(jnp.int32), mode="drop")
    index = index.at[j, at_j].set(i.astype(jnp.int32), mode="drop")
    links = links.at[i, at_i].set(link, mode="drop").at[j, at_j].set(link.T, mode="drop")
    return state._replace(diagonal=diagonal, counts=counts, neighbours=index, links=links)


def _enter_links(
    state: SparseState,
    i: Int[Array, ""],
    j: Int[Array, "A"],
    links: Float[Array, "A 2 2"],
    on: Bool[Array, "A"],
) -> SparseState:
    """`enter_link` of landmark i with each of j, where lists have room for all N - 1 others.

    Each link takes the first free entry of a list, as if they came one after the other.
    """
    n = state.alive.shape[0]
    on = on & ((links**2).sum(axis=(1, 2)) > 0)
    row = state.neighbours.at[i].get(mode="fill", fill_value=n)
    free = jnp.argsort(row < n, stable=True)
    at_i = jnp.where(on, free[jnp.cumsum(on) - 1], len(row))
    j = jnp.where(on, j, n)
    rows = state.neighbours.at[j].get(mode="fill", fill_value=0)
    at_j = jnp.argmax(rows == n, axis=1)
    index = state.neighbours.at[i, at_i].set(j.astype(jnp.int32), mode="drop")
    index = index.at[j, at_j].set(i.astype(jnp.int32), mode="drop")
    kept = state.links.at[i, at_i].set(links, mode="drop")
    kept = kept.at[j, at_j].set(jnp.swapaxes(links, 1, 2), mode="drop")
    return state._replace(neighbours=index, links=kept)


def active_matches(state: SparseState, association: TagAssociation) -> Bool[Array, "M A"]:
    """Mask of the measurements of the landmark at each index of the active set."""
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
    return index, slots.slot_mask(index, enters, len(by_order))


def deactivate(
    state: SparseState, leaving: Bool[Array, "A"], most: int, conservative: bool
) -> SparseState:
    """The state with at most `most` active landmarks without robot links made passive.

    Their links to active landmarks go to the lists; a full list drops one (`enter_link`).
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
        return _enter_links(state, state.active[a], state.active, blocks[a], on), None

    if state.neighbours.shape[1] >= n - 1:
        state, _ = jax.lax.scan(enter_row, state, (order, entered))
    else:
        pairs = jnp.repeat(order, count), jnp.tile(every, len(order)), entered.reshape(-1)
        state, _ = jax.lax.scan(enter_pair, state, pairs)
    diagonal = state.diagonal.at[state.active].get(mode="fill", fill_value=0)
    unit = jnp.eye(2, dtype=omega.dtype)
    empty = leaving | (state.active >= n)
    blocks = blocks.at[every, every].set(diagonal)
    blocks = jnp.where((leaving[:, None] | leaving[None, :])[:, :, None, None], 0.0, blocks)
    blocks = blocks.at[every, every].set(jnp.where(empty[:, None, None], unit, diagonal))
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
    diagonal = state.diagonal.at[jnp.where(entered, active, n)].get(mode="fill", fill_value=0)
    blocks = landmark_blocks(state.omega) + found
    every = jnp.arange(count)
    before = blocks[every, every]
    blocks = blocks.at[every, every].set(jnp.where(entered[:, None, None], diagonal, before))
    moved = match.any(axis=2)
    left = jnp.where(moved[:, :, None, None], 0.0, links)
    return state._replace(
        active=active,
        omega=with_landmark_blocks(state.omega, blocks),
        neighbours=state.neighbours.at[active].set(jnp.where(moved, n, rows), mode="drop"),
        links=state.links.at[active].set(left, mode="drop"),
    )
