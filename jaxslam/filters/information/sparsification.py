"""What moves between the area of a `sparse_state.Sparse` and its lists, and what that drops.

A landmark leaves the area without a link to the robot: `sparsified` cuts it, overconfidently
(`filters.seif`), or nothing is left to cut (`filters.eseif`).
"""

import jax
import jax.numpy as jnp

from jaxslam.filters.information.sparse_state import Counts, Sparse, blocks_of, with_blocks
from jaxslam.math import linalg
from jaxslam.math.xla import settle


def sparsified(omega: jax.Array, gone: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Ω̃ without links between the robot and the places gone (A,), and the nats dropped.

    x and m0 are made independent given the other active landmarks m+ (ERRATA's formula, Ω⁰ being
    the area: passive landmarks are held at their means there):

        Ω̃ = Ω - Ω F_m0 (..)⁻¹ F_m0ᵀ Ω + Ω F_x,m0 (..)⁻¹ F_x,m0ᵀ Ω - Ω F_x (..)⁻¹ F_xᵀ Ω,

    (..) the block of Ω that F selects. With G = Ω F_x - Ω F_m0 Ω_m0⁻¹ Ω_m0,x (D, 3) and Σ = F_xᵀ G,
    the information of x given m+ and not m0, that is Ω + G Σ⁻¹ Gᵀ - Ω F_x Ω_x⁻¹ F_xᵀ Ω. Positive
    definite as Ω is; ρ stays. Dropped is I(x; m0 | m+) = (log|Ω_x| - log|Σ|)/2. Ω̃ claims more than
    Ω in some directions.
    """
    leaves = jnp.concatenate([jnp.zeros(3, bool), jnp.repeat(gone, 2)])
    by_robot = omega[:, :3]
    eye = jnp.eye(len(omega), dtype=omega.dtype)
    of_gone = jnp.where(leaves[:, None] & leaves[None, :], omega, eye)
    to_gone = jnp.where(leaves[:, None], by_robot, 0.0)
    left = by_robot - omega @ linalg.solve_psd(of_gone, to_gone)[0]
    left = jnp.where(leaves[:, None], 0.0, left)
    before, after = linalg.whitener(omega[:3, :3])[0], linalg.whitener(left[:3])[0]
    new = omega + linalg.square(after @ left.T) - linalg.square(before @ by_robot.T)
    robot = jnp.arange(len(omega)) < 3
    cut = (leaves[:, None] & robot[None, :]) | (leaves[None, :] & robot[:, None])
    nats = jnp.maximum(_log_diagonal(after) - _log_diagonal(before), 0.0)
    any_gone = gone.any()
    return (
        jnp.where(any_gone, jnp.where(cut, 0.0, linalg.symmetrize(new)), omega),
        jnp.where(any_gone, nats, 0.0),
    )


def _log_diagonal(factor: jax.Array) -> jax.Array:
    pivots = jnp.diagonal(factor)
    return jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum()


def spring(link: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(B Bᵀ)^½ and (Bᵀ B)^½ of a link B (2, 2): the least U, V with [[U, B], [Bᵀ, V]] ⪰ 0.

    The square root of a 2×2 matrix M is (M + √|M| I)/√(tr M + 2 √|M|), and √|B Bᵀ| = |det B|.
    """
    det = jnp.abs(link[0, 0] * link[1, 1] - link[0, 1] * link[1, 0])
    square = (link**2).sum() + 2 * det
    there = square > 0
    scale = jnp.where(there, 1.0 / jnp.sqrt(jnp.where(there, square, 1.0)), 0.0)
    eye = det * jnp.eye(2, dtype=link.dtype)
    return (link @ link.T + eye) * scale, (link.T @ link + eye) * scale


def without_link(
    own: jax.Array,
    counts: Counts,
    i: jax.Array,
    j: jax.Array,
    link: jax.Array,
    on: jax.Array,
    conservative: bool,
) -> tuple[jax.Array, Counts]:
    """Diagonal blocks (N, 2, 2) and counts after a link Ω_ij = B is dropped, where on ().

    Definite: the spring [[U, -B], [-Bᵀ, V]] ⪰ 0 is added, so Ω̃ ⪰ Ω stays definite for certain, and
    claims more than Ω: both landmarks are anchored where they are.
    Conservative: the spring [[U, B], [Bᵀ, V]] ⪰ 0 is taken away, so Ω̃ ⪯ Ω claims less. Ω̃ is then
    definite only if Ω without this spring is, and of that the landmarks' own blocks alone can be
    asked at a constant cost: where one of them would lose half of what it has in some direction,
    the definite way is taken.
    """
    u, v = spring(link)
    n = own.shape[0]
    i, j = jnp.where(on, i, n), jnp.where(on, j, n)
    sign = jnp.ones((), own.dtype)
    if conservative:
        ours = own.at[i].get(mode="fill", fill_value=0)
        theirs = own.at[j].get(mode="fill", fill_value=0)
        spare = linalg.cholesky(ours - 2 * u)[1] & linalg.cholesky(theirs - 2 * v)[1]
        sign = jnp.where(spare, -sign, sign)
    own = own.at[i].add(sign * u, mode="drop").at[j].add(sign * v, mode="drop")
    norm = jnp.sqrt(jnp.where(on, (link**2).sum(), 1.0))
    return own, counts._replace(
        dropped=counts.dropped + on.astype(jnp.int32),
        dropped_links=counts.dropped_links + jnp.where(on, norm, 0.0),
        anchored=counts.anchored + (on & (sign > 0)).astype(jnp.int32),
    )


def linked(
    state: Sparse,
    i: jax.Array,
    j: jax.Array,
    link: jax.Array,
    on: jax.Array,
    conservative: bool = False,
) -> Sparse:
    """The link Ω_ij (2, 2) entered in the lists of landmarks i and j, where on () and it is not 0.

    A full list gives up its weakest link (least |Ω_ij|), or the new one is not entered if that is
    the weakest: `without_link`. `own` must be current for both.
    """
    n = state.own.shape[0]
    size = (link**2).sum()
    on = on & (size > 0)
    i, j = jnp.where(on, i, n), jnp.where(on, j, n)

    def weakest(of: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        row = state.neighbours.at[of].get(mode="fill", fill_value=n)
        links = state.links.at[of].get(mode="fill", fill_value=0)
        weight = jnp.where(row < n, (links**2).sum(axis=(1, 2)), -1.0)
        at = jnp.argmin(weight)
        return at, row[at], links[at], weight[at]

    # Read before anything is written: else XLA reads again later, from a copy of all N lists.
    found = settle((weakest(i), weakest(j)))
    (at_i, p, link_p, least_i), (at_j, q, link_q, least_j) = found
    keep = on & (size > least_i) & (size > least_j)
    index, links = state.neighbours, state.links
    own, counts = without_link(state.own, state.counts, i, j, link, on & ~keep, conservative)
    for mine, other, old, least in ((i, p, link_p, least_i), (j, q, link_q, least_j)):
        full = keep & (least >= 0)
        own, counts = without_link(own, counts, mine, other, old, full, conservative)
        row = index.at[jnp.where(full, other, n)].get(mode="fill", fill_value=n)
        back = row == mine
        gone = settle((jnp.where(full & back.any(), other, n), jnp.argmax(back)))
        index = index.at[gone].set(n, mode="drop")
        links = links.at[gone].set(0.0, mode="drop")
    i, j = jnp.where(keep, i, n), jnp.where(keep, j, n)
    index = index.at[i, at_i].set(j.astype(jnp.int32), mode="drop")
    index = index.at[j, at_j].set(i.astype(jnp.int32), mode="drop")
    links = links.at[i, at_i].set(link, mode="drop").at[j, at_j].set(link.T, mode="drop")
    return state._replace(own=own, counts=counts, neighbours=index, links=links)


def all_linked(
    state: Sparse, i: jax.Array, j: jax.Array, links: jax.Array, on: jax.Array
) -> Sparse:
    """`linked` of landmark i () with each of j (A,), where lists have room for all N - 1 others.

    Each link takes the first free place of a list, as if they came one after the other.
    """
    n = state.own.shape[0]
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


def retired(state: Sparse, gone: jax.Array, most: int, conservative: bool = False) -> Sparse:
    """The landmarks of the places gone (A,), at most `most` of them, made passive.

    They lose their link to the robot (`sparsified`), and their links to the area go to the lists.
    """
    omega, nats = sparsified(state.omega, gone)
    ties = (state.omega[:3, 3:] != 0).any(axis=0).reshape(-1, 2).any(axis=1)
    counts = state.counts._replace(
        cut=state.counts.cut + (gone & ties).sum(dtype=jnp.int32),
        cut_nats=state.counts.cut_nats + nats,
    )
    return departed(state._replace(omega=omega, counts=counts), gone, most, conservative)


def departed(state: Sparse, gone: jax.Array, most: int, conservative: bool = False) -> Sparse:
    """The places gone (A,), at most `most` of them, without a link to the robot, made empty.

    The links of their landmarks to the area go to the lists.
    """
    n, count = state.own.shape[0], gone.shape[0]
    omega = state.omega
    blocks = blocks_of(omega)
    diagonal = jnp.arange(count)
    state = state._replace(
        own=state.own.at[state.slot].set(blocks[diagonal, diagonal], mode="drop")
    )
    order = jnp.argsort(~gone, stable=True)[:most]
    # Each pair once: of two that leave, by the one that has its turn first.
    earlier = (order[:, None] == diagonal[None, :])[None, :, :] & (
        jnp.arange(len(order))[None, :] < jnp.arange(len(order))[:, None]
    )[:, :, None]
    wanted = gone[order][:, None] & (state.slot < n)[None, :] & ~earlier.any(axis=1)
    wanted = wanted & (order[:, None] != diagonal[None, :])

    def enter(state: Sparse, of: tuple[jax.Array, ...]) -> tuple[Sparse, None]:
        a, b, on = of
        pair = state.slot[a], state.slot[b]
        return linked(state, *pair, blocks[a, b], on, conservative), None

    def enter_all(state: Sparse, of: tuple[jax.Array, jax.Array]) -> tuple[Sparse, None]:
        a, on = of
        return all_linked(state, state.slot[a], state.slot, blocks[a], on), None

    if state.neighbours.shape[1] >= n - 1:
        state, _ = jax.lax.scan(enter_all, state, (order, wanted))
    else:
        pairs = jnp.repeat(order, count), jnp.tile(diagonal, len(order)), wanted.reshape(-1)
        state, _ = jax.lax.scan(enter, state, pairs)
    own = state.own.at[state.slot].get(mode="fill", fill_value=0)
    unit = jnp.eye(2, dtype=omega.dtype)
    out = gone | (state.slot >= n)
    blocks = blocks.at[diagonal, diagonal].set(own)
    blocks = jnp.where((gone[:, None] | gone[None, :])[:, :, None, None], 0.0, blocks)
    blocks = blocks.at[diagonal, diagonal].set(jnp.where(out[:, None, None], unit, own))
    return state._replace(
        omega=with_blocks(omega, blocks),
        slot=jnp.where(gone, n, state.slot).astype(jnp.int32),
    )


def activated(state: Sparse, place: jax.Array, slot: jax.Array, on: jax.Array) -> Sparse:
    """The landmarks slot (M,) made active at empty places (M,), where on (M,).

    Their own blocks, and their links to others that are active now, move to the area.
    """
    n, count = state.own.shape[0], state.slot.shape[0]
    at = jnp.where(on, place, count)
    slots = state.slot.at[at].set(slot.astype(jnp.int32), mode="drop")
    fresh = jnp.zeros(count, bool).at[at].set(True, mode="drop")
    rows = state.neighbours.at[slots].get(mode="fill", fill_value=n)
    links = state.links.at[slots].get(mode="fill", fill_value=0)
    rows, links = settle((rows, links))
    match = (rows[:, :, None] == slots[None, None, :]) & (slots < n)[None, None, :]
    found = jnp.einsum("akij,akb->abij", links, match.astype(links.dtype))
    own = state.own.at[jnp.where(fresh, slots, n)].get(mode="fill", fill_value=0)
    blocks = blocks_of(state.omega) + found
    diagonal = jnp.arange(count)
    was = blocks[diagonal, diagonal]
    blocks = blocks.at[diagonal, diagonal].set(jnp.where(fresh[:, None, None], own, was))
    moved = match.any(axis=2)
    return state._replace(
        slot=slots,
        omega=with_blocks(state.omega, blocks),
        neighbours=state.neighbours.at[slots].set(jnp.where(moved, n, rows), mode="drop"),
        links=state.links.at[slots].set(
            jnp.where(moved[:, :, None, None], 0.0, links), mode="drop"
        ),
    )
