"""The sparse canonical form of `filters.seif`: a dense area around the robot, and lists of links.

Ω of the robot and the A active landmarks is one dense block, the area. A passive landmark has no
link to the robot; what it shares with other landmarks stands in its list of at most K links. A pair
of which both are active is in the area alone, every other in the lists of both. So a motion or a
scan touches the area, and no array of N landmarks is read or written but at a few rows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Counts(NamedTuple):
    """What was approximated so far, or went wrong."""

    cut: jax.Array
    """() int32: landmarks whose link to the robot was cut by sparsification"""
    cut_nats: jax.Array
    """() Σ I(x; m0 | active): information that sparsification dropped, in nats"""
    dropped: jax.Array
    """() int32: links between landmarks dropped, their lists being full"""
    dropped_links: jax.Array
    """() Σ |Ω_ij| (Frobenius) of the same"""
    anchored: jax.Array
    """() int32: how many of them were dropped the definite way, overconfidently"""
    broken: jax.Array
    """() int32: scans refused because the area was not positive definite"""
    relocated: jax.Array
    """() int32: how often the robot's pose was marginalized out, and found anew (`eseif`)"""


class Sparse(NamedTuple):
    """Robot and map; μ, ρ and padding as in `filters.canonical`. A landmark's slot is its tag."""

    pose: jax.Array
    """(3,)"""
    landmarks: jax.Array
    """(N, 2)"""
    owed_robot: jax.Array
    """(3,) ρ of the robot"""
    owed: jax.Array
    """(N, 2) ρ of the landmarks"""
    alive: jax.Array
    """(N,) bool"""
    slot: jax.Array
    """(A,) int32 which landmark is active at each place of the area, N for none"""
    seen: jax.Array
    """(A,) int32: the scan in which it was last measured"""
    omega: jax.Array
    """(3 + 2A, 3 + 2A) Ω of the robot and the active landmarks; unit diagonal where none"""
    own: jax.Array
    """(N, 2, 2) diagonal blocks of Ω; of an active landmark that in `omega` counts"""
    neighbours: jax.Array
    """(N, K) int32 which landmarks each is linked to, N for none"""
    links: jax.Array
    """(N, K, 2, 2) Ω_ij of the same"""
    turn: jax.Array
    """() int32: the passive landmark whose mean is recovered next"""
    scans: jax.Array
    """() int32"""
    counts: Counts


def empty(pose: jax.Array, start: jax.Array, capacity: int, active: int, links: int) -> Sparse:
    """A robot with information start (3, 3) and no landmark."""
    dtype, none = pose.dtype, jnp.zeros((), jnp.int32)
    eye = jnp.eye(2, dtype=dtype)
    nothing = jnp.zeros((), dtype)
    return Sparse(
        pose=pose,
        landmarks=jnp.zeros((capacity, 2), dtype),
        owed_robot=jnp.zeros(3, dtype),
        owed=jnp.zeros((capacity, 2), dtype),
        alive=jnp.zeros(capacity, bool),
        slot=jnp.full(active, capacity, jnp.int32),
        seen=jnp.zeros(active, jnp.int32),
        omega=jnp.eye(3 + 2 * active, dtype=dtype).at[:3, :3].set(start),
        own=jnp.broadcast_to(eye, (capacity, 2, 2)),
        neighbours=jnp.full((capacity, links), capacity, jnp.int32),
        links=jnp.zeros((capacity, links, 2, 2), dtype),
        turn=none,
        scans=none,
        counts=Counts(none, nothing, none, nothing, none, none, none),
    )


def blocks_of(omega: jax.Array) -> jax.Array:
    """(A, A, 2, 2) of the landmarks of an area."""
    count = (omega.shape[0] - 3) // 2
    return omega[3:, 3:].reshape(count, 2, count, 2).transpose(0, 2, 1, 3)


def with_blocks(omega: jax.Array, blocks: jax.Array) -> jax.Array:
    """The area with other blocks (A, A, 2, 2) of landmarks."""
    count = blocks.shape[0]
    flat = blocks.transpose(0, 2, 1, 3).reshape(2 * count, 2 * count)
    return omega.at[3:, 3:].set(flat)
