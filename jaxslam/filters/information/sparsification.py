"""Sparsification: functions that drop links to the robot and links between landmarks.

1. Robot to landmark, `sparsify`: when landmarks m0 leave the active set, the links between them and
   the robot x are set to zero, so that x and m0 are independent given the other active landmarks:

       Ω̃ = Ω + G Σ⁻¹ Gᵀ - Ω F_x Ω_x⁻¹ F_xᵀ Ω,   G = Ω F_x - Ω F_m0 Ω_m0⁻¹ Ω_m0,x,   Σ = F_xᵀ G.

   `seif` does it in every scan that needs room. `ApproximationCounts.cut` and `.cut_nats` count
   what was dropped.
2. Landmark to landmark, `drop_link`: a landmark's list has room for K links; a full list drops its
   weakest link Ω_ij (`active_set`), and the two diagonal blocks change so that Ω̃ stays positive
   definite. `.dropped`, `.dropped_links` and `.anchored` count it.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.filters.information.sparse_state import (
    ApproximationCounts,
    SparseState,
    linked_to_robot,
)
from jaxslam.math import linalg
from jaxslam.math.gaussians import log_det_of


def sparsify(
    omega: Float[Array, "D D"], leaving: Bool[Array, "A"]
) -> tuple[Float[Array, "D D"], Float[Array, ""]]:
    """Ω̃ of the active block without links from the robot to leaving landmarks; the nats dropped.

    x and m0 are made independent given the other active landmarks m+ (the Notes' formula as the
    errata have it, Ω⁰ being the active block: passive landmarks are held at their means there):

        Ω̃ = Ω - Ω F_m0 (..)⁻¹ F_m0ᵀ Ω + Ω F_x,m0 (..)⁻¹ F_x,m0ᵀ Ω - Ω F_x (..)⁻¹ F_xᵀ Ω,

    (..) the block of Ω that F selects. With G = Ω F_x - Ω F_m0 Ω_m0⁻¹ Ω_m0,x (D, 3) and Σ = F_xᵀ G,
    the information of x given m+ and not m0, that is Ω + G Σ⁻¹ Gᵀ - Ω F_x Ω_x⁻¹ F_xᵀ Ω. Positive
    definite as Ω is; ρ stays. I(x; m0 | m+) = (log|Ω_x| - log|Σ|)/2 [nats] is dropped. Ω̃ contains
    more information than Ω in some directions (it is overconfident there).
    """
    leaves = jnp.concatenate([jnp.zeros(3, bool), jnp.repeat(leaving, 2)])
    by_robot = omega[:, :3]
    eye = jnp.eye(len(omega), dtype=omega.dtype)
    of_leaving = jnp.where(leaves[:, None] & leaves[None, :], omega, eye)
    to_leaving = jnp.where(leaves[:, None], by_robot, 0.0)
    g = by_robot - omega @ linalg.solve_psd(of_leaving, to_leaving)[0]
    g = jnp.where(leaves[:, None], 0.0, g)
    root_x, root_sigma = linalg.whitener(omega[:3, :3])[0], linalg.whitener(g[:3])[0]
    new = omega + linalg.self_gram(root_sigma @ g.T) - linalg.self_gram(root_x @ by_robot.T)
    robot = jnp.arange(len(omega)) < 3
    cut = (leaves[:, None] & robot[None, :]) | (leaves[None, :] & robot[:, None])
    # Of the inverse factors, hence of Σ⁻¹ and Ω_x⁻¹.
    nats = jnp.maximum(0.5 * (log_det_of(root_sigma) - log_det_of(root_x)), 0.0)
    any_leaves = leaving.any()
    return (
        jnp.where(any_leaves, jnp.where(cut, 0.0, linalg.symmetrize(new)), omega),
        jnp.where(any_leaves, nats, 0.0),
    )


def cut_robot_links(state: SparseState, leaving: Bool[Array, "A"]) -> SparseState:
    """The state with the robot links of leaving active landmarks dropped, and counted."""
    omega, nats = sparsify(state.omega, leaving)
    counts = state.counts._replace(
        cut=state.counts.cut + (leaving & linked_to_robot(state.omega)).sum(dtype=jnp.int32),
        cut_nats=state.counts.cut_nats + nats,
    )
    return state._replace(omega=omega, counts=counts)


def psd_completion(
    link: Float[Array, "2 2"],
) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"]]:
    """The least U, V with [[U, B], [Bᵀ, V]] ⪰ 0 for a link B: (B Bᵀ)^½ and (Bᵀ B)^½.

    The square root of a 2×2 matrix M is (M + √|M| I)/√(tr M + 2 √|M|), and √|B Bᵀ| = |det B|.
    """
    det = jnp.abs(link[0, 0] * link[1, 1] - link[0, 1] * link[1, 0])
    square = (link**2).sum() + 2 * det
    nonzero = square > 0
    scale = jnp.where(nonzero, 1.0 / jnp.sqrt(jnp.where(nonzero, square, 1.0)), 0.0)
    eye = det * jnp.eye(2, dtype=link.dtype)
    return (link @ link.T + eye) * scale, (link.T @ link + eye) * scale


def drop_link(
    diagonal: Float[Array, "N 2 2"],
    counts: ApproximationCounts,
    i: Int[Array, ""],
    j: Int[Array, ""],
    link: Float[Array, "2 2"],
    on: Bool[Array, ""],
    conservative: bool,
) -> tuple[Float[Array, "N 2 2"], ApproximationCounts]:
    """Diagonal blocks of Ω, and counts, after a link Ω_ij = B is dropped, where on.

    With the least U and V of `psd_completion`:
    Overconfident: [[U, -B], [-Bᵀ, V]] ⪰ 0 is added, so Ω̃ ⪰ Ω is certainly positive definite, with
    spurious information that anchors both landmarks at their means.
    Conservative: [[U, B], [Bᵀ, V]] ⪰ 0 is subtracted, so Ω̃ ⪯ Ω. Whether Ω̃ is positive definite
    cannot be tested at a constant cost, so only the two diagonal blocks are tested: where one of
    them would lose half of its information in some direction, the link is dropped overconfidently.
    """
    u, v = psd_completion(link)
    n = diagonal.shape[0]
    i, j = jnp.where(on, i, n), jnp.where(on, j, n)
    sign = jnp.ones((), diagonal.dtype)
    if conservative:
        at_i = diagonal.at[i].get(mode="fill", fill_value=0)
        at_j = diagonal.at[j].get(mode="fill", fill_value=0)
        spare = linalg.cholesky(at_i - 2 * u)[1] & linalg.cholesky(at_j - 2 * v)[1]
        sign = jnp.where(spare, -sign, sign)
    diagonal = diagonal.at[i].add(sign * u, mode="drop").at[j].add(sign * v, mode="drop")
    norm = jnp.sqrt(jnp.where(on, (link**2).sum(), 1.0))
    return diagonal, counts._replace(
        dropped=counts.dropped + on.astype(jnp.int32),
        dropped_links=counts.dropped_links + jnp.where(on, norm, 0.0),
        anchored=counts.anchored + (on & (sign > 0)).astype(jnp.int32),
    )
