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
    """The state with the link Ω_ij in the lists of landmarks i and j, where on and Ω_ij is not 0.

    A full list drops its weakest link (least |Ω_ij|), which may be the new link itself:
    `sparse_state.drop_link`. `diagonal` must be current for both landmarks.
    """
    n = state.alive.shape[0]
    size = (link**2).sum()
    on = on & (size > 0)
    i, j = jnp.where(on, i, n), jnp.where(on, j, n)

    def weakest_link(landmark: Array) -> tuple[Array, Array, Array, Array]:
        """The entry of a landmark's weakest link, its other end, Ω_ij and |Ω_ij|²; -1 if free."""
        row = state.neighbours.at[landmark].get(mode="fill", fill_value=n)
        links = state.links.at[landmark].get(mode="fill", fill_value=0)
        weight = jnp.where(row < n, (links**2).sum(axis=(1, 2)), -1.0)
        at = jnp.argmin(weight)
        return at, row[at], links[at], weight[at]

    # Read before any write; otherwise XLA copies all N lists to read them later.
    weakest = materialize((weakest_link(i), weakest_link(j)))
    (at_i, p, link_p, least_i), (at_j, q, link_q, least_j) = weakest
    keep = on & (size > least_i) & (size > least_j)
    index, links = state.neighbours, state.links
    diagonal, counts = drop_link(state.diagonal, state.counts, i, j, link, on & ~keep, conservative)
    for landmark, partner, dropped, least in ((i, p, link_p, least_i), (j, q, link_q, least_j)):
        full = keep & (least >= 0)
        diagonal, counts = drop_link(
            diagonal, counts, landmark, partner, dropped, full, conservative
        )
        # The link is in the list of the partner too.
        row = index.at[jnp.where(full, partner, n)].get(mode="fill", fill_value=n)
        is_back = row == landmark
        # Computed before the write, for which XLA would copy all N lists otherwise.
        back = materialize((jnp.where(full & is_back.any(), partner, n), jnp.argmax(is_back)))
        index = index.at[back].set(n, mode="drop")
        links = links.at[back].set(0.0, mode="drop")
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
    """`enter_link` of landmark i with all of j, where lists have room for all N - 1 landmarks.

    A link takes the first free entry of a list, as if the links came one after the other.
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
    lists = state.links.at[i, at_i].set(links, mode="drop")
    lists = lists.at[j, at_j].set(jnp.swapaxes(links, 1, 2), mode="drop")
    return state._replace(neighbours=index, links=lists)


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
    """The index of each measured landmark in the active set, and the mask of those newly assigned.

    Landmarks that enter get the indices of least `order`, in the order of their `rank`; the other
    ones keep the index at which they match (`active_matches`).
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
    k = jnp.arange(count)
    state = state._replace(diagonal=state.diagonal.at[state.active].set(blocks[k, k], mode="drop"))
    order = jnp.argsort(~leaving, stable=True)[:most]
    # A pair of two that leave is entered once, by the one that is processed first: axes are
    # (processed later, processed earlier, index in the active set).
    is_earlier = jnp.arange(len(order))[None, :] < jnp.arange(len(order))[:, None]
    earlier = (order[:, None] == k[None, :])[None, :, :] & is_earlier[:, :, None]
    entered = leaving[order][:, None] & (state.active < n)[None, :] & ~earlier.any(axis=1)
    entered = entered & (order[:, None] != k[None, :])

    def enter_pair(state: SparseState, pair: tuple[Array, ...]) -> tuple[SparseState, None]:
        a, b, on = pair
        ends = state.active[a], state.active[b]
        return enter_link(state, *ends, blocks[a, b], on, conservative), None

    def enter_row(state: SparseState, row: tuple[Array, ...]) -> tuple[SparseState, None]:
        a, on = row
        return _enter_links(state, state.active[a], state.active, blocks[a], on), None

    # Lists with room for all other landmarks are never full: a row is entered at once.
    if state.neighbours.shape[1] >= n - 1:
        state, _ = jax.lax.scan(enter_row, state, (order, entered))
    else:
        pairs = jnp.repeat(order, count), jnp.tile(k, len(order)), entered.reshape(-1)
        state, _ = jax.lax.scan(enter_pair, state, pairs)
    diagonal = state.diagonal.at[state.active].get(mode="fill", fill_value=0)
    unit = jnp.eye(2, dtype=omega.dtype)
    empty = leaving | (state.active >= n)
    blocks = blocks.at[k, k].set(diagonal)
    blocks = jnp.where((leaving[:, None] | leaving[None, :])[:, :, None, None], 0.0, blocks)
    blocks = blocks.at[k, k].set(jnp.where(empty[:, None, None], unit, diagonal))
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
    # Read before the lists are written, else XLA copies all N of them.
    rows, links = materialize((rows, links))
    match = (rows[:, :, None] == active[None, None, :]) & (active < n)[None, None, :]
    listed = jnp.einsum("akij,akb->abij", links, match.astype(links.dtype))
    diagonal = state.diagonal.at[jnp.where(entered, active, n)].get(mode="fill", fill_value=0)
    blocks = landmark_blocks(state.omega) + listed
    k = jnp.arange(count)
    before = blocks[k, k]
    blocks = blocks.at[k, k].set(jnp.where(entered[:, None, None], diagonal, before))
    moved = match.any(axis=2)
    left = jnp.where(moved[:, :, None, None], 0.0, links)
    return state._replace(
        active=active,
        omega=with_landmark_blocks(state.omega, blocks),
        neighbours=state.neighbours.at[active].set(jnp.where(moved, n, rows), mode="drop"),
        links=state.links.at[active].set(left, mode="drop"),
    )
