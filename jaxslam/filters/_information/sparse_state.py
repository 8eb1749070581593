"""The sparse canonical form of `filters.Seif`: a dense active block of Ω, and lists of links.

Ω of the robot and the A active landmarks is one dense block. A passive landmark has no link to the
robot; its links to other landmarks are in its list of at most K. A pair of active landmarks is
only in the dense block, every other pair in both lists. So a motion or a scan changes the
dense block, and only a few rows of arrays of N landmarks are read or written.

Sparsification drops links to the robot and links between landmarks.

1. Robot to landmark, `sparsify`: when landmarks m0 leave the active set, the links between them and
   the robot x are set to zero, so that x and m0 are independent given the other active landmarks:

       Ω̃ = Ω + G Σ⁻¹ Gᵀ - Ω F_x Ω_x⁻¹ F_xᵀ Ω,   G = Ω F_x - Ω F_m0 Ω_m0⁻¹ Ω_m0,x,   Σ = F_xᵀ G.

   `seif` does it in every scan that needs room. `ApproximationCounts.cut` and `.cut_nats` count
   what was dropped.
2. Landmark to landmark, `drop_link`: a landmark's list has room for K links; a full list drops its
   weakest link Ω_ij (`active_set`), and the two diagonal blocks change so that Ω̃ stays positive
   definite. `.dropped`, `.dropped_links` and `.anchored` count it.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import log_det_of


class ApproximationCounts(NamedTuple):
    """Counts of approximations and failures since the start."""

    cut: Int[Array, ""]
    """landmarks whose link to the robot was removed (`sparse_state.sparsify`)"""
    cut_nats: Float[Array, ""]
    """Σ I(x; m0 | active) that sparsification dropped, in nats"""
    dropped: Int[Array, ""]
    """links between landmarks dropped, their lists being full (`sparse_state.drop_link`)"""
    dropped_links: Float[Array, ""]
    """Σ |Ω_ij| (Frobenius) of the dropped links"""
    anchored: Int[Array, ""]
    """links dropped overconfidently, so that Ω stays positive definite"""
    refused: Int[Array, ""]
    """scans refused because Ω of the active block was not positive definite"""


class SparseState(NamedTuple):
    """Robot and map; μ, ρ and padding as in `canonical`. A landmark's slot is its tag."""

    pose: Float[Array, "3"]
    landmarks: Float[Array, "N 2"]
    pose_residual: Float[Array, "3"]
    """information residual ρ of the robot"""
    landmark_residual: Float[Array, "N 2"]
    """ρ of the landmarks"""
    alive: Bool[Array, "N"]
    active: Int[Array, "A"]
    """slots of the active landmarks, by their index in the dense block; N for none"""
    last_measured: Int[Array, "A"]
    """the scan in which each active landmark was last measured"""
    omega: Float[Array, "D D"]
    """Ω of the robot and the active landmarks, D = 3 + 2A; unit diagonal at unused indices"""
    diagonal: Float[Array, "N 2 2"]
    """diagonal blocks of Ω of the passive landmarks; those of active landmarks are in `omega`"""
    neighbours: Int[Array, "N K"]
    """slots of the landmarks to which each landmark is linked, N for none"""
    links: Float[Array, "N K 2 2"]
    """Ω_ij of the landmark and its neighbours"""
    next_recovered: Int[Array, ""]
    """the passive landmark whose mean is recovered next"""
    scans: Int[Array, ""]
    """number of processed scans"""
    counts: ApproximationCounts


def empty_map(
    pose: Float[Array, "3"],
    information: Float[Array, "3 3"],
    capacity: int,
    active: int,
    links: int,
) -> SparseState:
    """The initial state: a robot and no landmark."""
    dtype, none = pose.dtype, jnp.zeros((), jnp.int32)
    zero = jnp.zeros((), dtype)
    return SparseState(
        pose=pose,
        landmarks=jnp.zeros((capacity, 2), dtype),
        pose_residual=jnp.zeros(3, dtype),
        landmark_residual=jnp.zeros((capacity, 2), dtype),
        alive=jnp.zeros(capacity, bool),
        active=jnp.full(active, capacity, jnp.int32),
        last_measured=jnp.zeros(active, jnp.int32),
        omega=jnp.eye(3 + 2 * active, dtype=dtype).at[:3, :3].set(information),
        diagonal=jnp.broadcast_to(jnp.eye(2, dtype=dtype), (capacity, 2, 2)),
        neighbours=jnp.full((capacity, links), capacity, jnp.int32),
        links=jnp.zeros((capacity, links, 2, 2), dtype),
        next_recovered=none,
        scans=none,
        counts=ApproximationCounts(none, zero, none, zero, none, none),
    )


def active_means(state: SparseState) -> Float[Array, "A 2"]:
    """The means of the active landmarks, 0 at unused indices."""
    means: Array = state.landmarks.at[state.active].get(mode="fill", fill_value=0)
    return means


def active_residual(state: SparseState) -> Float[Array, "D"]:
    """The information residual ρ of the robot and the active landmarks."""
    landmarks = state.landmark_residual.at[state.active].get(mode="fill", fill_value=0)
    return jnp.concatenate([state.pose_residual, landmarks.reshape(-1)])


def with_active_residual(state: SparseState, residual: Float[Array, "D"]) -> SparseState:
    """The state with ρ of the robot and the active landmarks."""
    landmarks = residual[3:].reshape(-1, 2)
    after = state.landmark_residual.at[state.active].set(landmarks, mode="drop")
    return state._replace(pose_residual=residual[:3], landmark_residual=after)


def linked_to_robot(omega: Float[Array, "D D"]) -> Bool[Array, "A"]:
    """Mask of the active landmarks that are linked to the robot."""
    linked: Array = (omega[:3, 3:] != 0).any(axis=0).reshape(-1, 2).any(axis=1)
    return linked


def landmark_blocks(omega: Float[Array, "D D"]) -> Float[Array, "A A 2 2"]:
    """The blocks of Ω of the active landmarks."""
    count = (omega.shape[0] - 3) // 2
    # (i, row, j, column) -> (i, j, row, column).
    return omega[3:, 3:].reshape(count, 2, count, 2).transpose(0, 2, 1, 3)


def with_landmark_blocks(
    omega: Float[Array, "D D"], blocks: Float[Array, "A A 2 2"]
) -> Float[Array, "D D"]:
    """Ω with the blocks of the active landmarks replaced."""
    count = blocks.shape[0]
    flat = blocks.transpose(0, 2, 1, 3).reshape(2 * count, 2 * count)
    return omega.at[3:, 3:].set(flat)


def sparsify(
    omega: Float[Array, "D D"], leaving: Bool[Array, "A"]
) -> tuple[Float[Array, "D D"], Float[Array, ""]]:
    """Ω̃ of the active block without links from the robot to leaving landmarks; the nats dropped.

    x and m0 are made independent given the other active landmarks m+ (the Notes' formula as the
    errata have it, Ω⁰ being the active block: passive landmarks are held at their means there):

        Ω̃ = Ω - Ω F_m0 (..)⁻¹ F_m0ᵀ Ω + Ω F_x,m0 (..)⁻¹ F_x,m0ᵀ Ω - Ω F_x (..)⁻¹ F_xᵀ Ω,

    (..) the block of Ω that F selects. With G = Ω F_x - Ω F_m0 Ω_m0⁻¹ Ω_m0,x (D, 3) and Σ = F_xᵀ G,
    the information of x given m+ after m0 is marginalized out, that is

        Ω̃ = (Ω - Ω F_x Ω_x⁻¹ F_xᵀ Ω) + G Σ⁻¹ Gᵀ,

    the information of p(m) of the map, x marginalized out, and of p(x | m+). A product of densities
    is one: Ω̃ of the whole map is positive definite if Ω is, for x has no link to a passive
    landmark. ρ does not change. I(x; m0 | m+) = (log|Ω_x| - log|Σ|)/2 [nats] is dropped. Ω̃ contains
    more information than Ω in some directions (it is overconfident there).
    """
    leaves = jnp.concatenate([jnp.zeros(3, bool), jnp.repeat(leaving, 2)])
    by_robot = omega[:, :3]
    eye = jnp.eye(len(omega), dtype=omega.dtype)
    # The identity in place of all that stays: the number of leaving landmarks is no static shape.
    of_leaving = jnp.where(leaves[:, None] & leaves[None, :], omega, eye)
    to_leaving = jnp.where(leaves[:, None], by_robot, 0.0)
    g = by_robot - omega @ linalg.solve_psd(of_leaving, to_leaving)[0]
    # Zero but for rounding, since m0 is marginalized out.
    g = jnp.where(leaves[:, None], 0.0, g)
    root_x, root_sigma = linalg.whitener(omega[:3, :3])[0], linalg.whitener(g[:3])[0]
    new = omega + linalg.self_gram(root_sigma @ g.T) - linalg.self_gram(root_x @ by_robot.T)
    robot = jnp.arange(len(omega)) < 3
    # Exact zeros in place of rounding: `linked_to_robot` asks whether a block is zero.
    cut = (leaves[:, None] & robot[None, :]) | (leaves[None, :] & robot[:, None])
    # The roots are inverse factors, so these are log-determinants of Σ⁻¹ and Ω_x⁻¹.
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
    # `square` is tr M + 2 √|M| of M = B Bᵀ or Bᵀ B, which have the same trace and determinant.
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
    # Slot n is beyond the end: reads give 0, writes are dropped.
    n = diagonal.shape[0]
    i, j = jnp.where(on, i, n), jnp.where(on, j, n)
    sign = jnp.ones((), diagonal.dtype)
    if conservative:
        at_i = diagonal.at[i].get(mode="fill", fill_value=0)
        at_j = diagonal.at[j].get(mode="fill", fill_value=0)
        # Ω_ii - 2U ≻ 0: at least half of Ω_ii is left in each direction after U is subtracted.
        spare = linalg.cholesky(at_i - 2 * u)[1] & linalg.cholesky(at_j - 2 * v)[1]
        sign = jnp.where(spare, -sign, sign)
    diagonal = diagonal.at[i].add(sign * u, mode="drop").at[j].add(sign * v, mode="drop")
    # 1 where nothing is dropped: √ has no finite derivative at zero.
    norm = jnp.sqrt(jnp.where(on, (link**2).sum(), 1.0))
    return diagonal, counts._replace(
        dropped=counts.dropped + on.astype(jnp.int32),
        dropped_links=counts.dropped_links + jnp.where(on, norm, 0.0),
        anchored=counts.anchored + (on & (sign > 0)).astype(jnp.int32),
    )
