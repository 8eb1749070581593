"""The sparse canonical form of `filters.Seif`: a dense active block of Ω, and lists of links.

Ω of the robot and the A active landmarks is one dense block. A passive landmark has no link to the
robot; its links to other landmarks are in its list of at most K. A pair of active landmarks is
only in the dense block, every other pair in both lists. So a motion or a scan changes the
dense block, and only a few rows of arrays of N landmarks are read or written.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int


class ApproximationCounts(NamedTuple):
    """Counts of approximations and failures since the start."""

    cut: Int[Array, ""]
    """landmarks whose link to the robot was removed (`sparsification.sparsify`)"""
    cut_nats: Float[Array, ""]
    """Σ I(x; m0 | active) that sparsification dropped, in nats"""
    dropped: Int[Array, ""]
    """links between landmarks dropped, their lists being full (`sparsification.drop_link`)"""
    dropped_links: Float[Array, ""]
    """Σ |Ω_ij| (Frobenius) of the same"""
    anchored: Int[Array, ""]
    """number of them dropped overconfidently, so that Ω stays positive definite"""
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
    """the scan in which each was last measured"""
    omega: Float[Array, "D D"]
    """Ω of the robot and the active landmarks, D = 3 + 2A; unit diagonal at unused indices"""
    diagonal: Float[Array, "N 2 2"]
    """diagonal blocks of Ω; of an active landmark the block in `omega` counts instead"""
    neighbours: Int[Array, "N K"]
    """slots of the landmarks that each is linked to, N for none"""
    links: Float[Array, "N K 2 2"]
    """Ω_ij of the same"""
    next_recovered: Int[Array, ""]
    """the passive landmark whose mean is recovered next"""
    scans: Int[Array, ""]
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
    """Which active landmarks are linked to the robot."""
    linked: Array = (omega[:3, 3:] != 0).any(axis=0).reshape(-1, 2).any(axis=1)
    return linked


def landmark_blocks(omega: Float[Array, "D D"]) -> Float[Array, "A A 2 2"]:
    """The blocks of Ω of the active landmarks."""
    count = (omega.shape[0] - 3) // 2
    return omega[3:, 3:].reshape(count, 2, count, 2).transpose(0, 2, 1, 3)


def with_landmark_blocks(
    omega: Float[Array, "D D"], blocks: Float[Array, "A A 2 2"]
) -> Float[Array, "D D"]:
    """Ω with the blocks of the active landmarks replaced."""
    count = blocks.shape[0]
    flat = blocks.transpose(0, 2, 1, 3).reshape(2 * count, 2 * count)
    return omega.at[3:, 3:].set(flat)
