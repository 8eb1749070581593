"""Insertion of links into the lists of a `SparseState`; a full list drops its weakest link."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.information.sparse.sparse_state import SparseState
from jaxslam.filters.information.sparse.sparsification import drop_link
from jaxslam.math.xla import materialize


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
    weakest: `sparsification.drop_link`. `diagonal` must be current for both landmarks.
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

    # Read before any write: XLA would else copy all N lists to read them later.
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


def enter_links(
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
