"""The fixed-capacity landmark table: a joint Gaussian over the robot and N landmark slots.

The padding invariant: a dead slot has zero mean, zero cross-covariance, unit variance and tag -1.
So the covariance is positive definite whenever its living part is, and every product with a dead
slot's rows is zero: padding is inert without a mask in the filter's equations.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.linalg import total


class Joint(NamedTuple):
    """Robot and map (Solà (5), (6)); D = 3 + N·L, slot i owns rows 3 + i·L to 3 + (i+1)·L."""

    pose: jax.Array
    """(3,)"""
    landmarks: jax.Array
    """(N, L)"""
    cov: jax.Array
    """(D, D) covariance of the error in the filter's chart, robot first."""
    alive: jax.Array
    """(N,) bool"""
    tag: jax.Array
    """(N,) int32, -1 where dead"""
    lin: Any
    """the linearizer's memory"""


def empty(
    pose: jax.Array, pose_cov: jax.Array, capacity: int, landmark_size: int, lin: Any = ()
) -> Joint:
    """A robot and no landmark (Solà (7)); pose_cov (3, 3) may be zero."""
    size = 3 + capacity * landmark_size
    return Joint(
        pose=pose,
        landmarks=jnp.zeros((capacity, landmark_size), pose.dtype),
        cov=jnp.eye(size, dtype=pose.dtype).at[:3, :3].set(pose_cov),
        alive=jnp.zeros(capacity, bool),
        tag=jnp.full(capacity, -1, jnp.int32),
        lin=lin,
    )


def find(tag: jax.Array, alive: jax.Array, wanted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The slot (M,) of each wanted tag (M,), 0 where there is none, and whether there is one (M,)."""
    match = (wanted[:, None] == tag[None, :]) & alive[None, :]
    return jnp.argmax(match, axis=1).astype(jnp.int32), match.any(axis=1)


def allocate(alive: jax.Array, wanted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A free slot for each place that wants one: the first wish gets the lowest free slot, and so on.

    alive (N,) and wanted (M,) bool -> slot (M,) int32, 0 where none, and granted (M,) bool.
    """
    free = ~alive
    rank_of_slot = jnp.where(free, jnp.cumsum(free), 0)
    rank_of_wish = jnp.where(wanted, jnp.cumsum(wanted), -1)
    match = rank_of_wish[:, None] == rank_of_slot[None, :]
    return jnp.argmax(match, axis=1).astype(jnp.int32), match.any(axis=1)


def gather(joint: Joint, slot: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The landmark (L,) in a slot () and its rows (L, D) of the covariance."""
    size = joint.landmarks.shape[1]
    landmark = jax.lax.dynamic_index_in_dim(joint.landmarks, slot, keepdims=False)
    return landmark, jax.lax.dynamic_slice_in_dim(joint.cov, 3 + slot * size, size)


def scatter(
    joint: Joint,
    born: jax.Array,
    landmarks: jax.Array,
    by_pose: jax.Array,
    own_cov: jax.Array,
    tag: jax.Array,
) -> Joint:
    """Fill dead slots with landmarks that depend on the map through the pose alone (Solà (35)-(38)).

    Slots i with born[i] get mean landmarks[i], cross-covariance by_pose[i] P_R: and covariance
    by_pose[i] P_RR by_pose[i]ᵀ + own_cov[i]; the covariance between two of them is
    by_pose[i] P_RR by_pose[j]ᵀ. The other slots of the arguments are not read.

    born (N,) bool, landmarks (N, L), by_pose (N, L, 3), own_cov (N, L, L), tag (N,).
    """
    capacity, size = joint.landmarks.shape
    new = coordinates(born, size, robot=False)
    gain = jnp.concatenate(
        [jnp.zeros((3, 3), joint.cov.dtype), by_pose.reshape(capacity * size, 3)]
    )
    gain = jnp.where(new[:, None], gain, 0.0)
    # Robot rows first: P_RL of a new landmark, then every new row follows from the robot's rows.
    robot = joint.cov[:3, :]
    robot_new = total(joint.cov[:3, k, None] * gain[None, :, k] for k in range(3))
    robot = jnp.where(new[None, :], robot_new, robot)
    rows = total(gain[:, k, None] * robot[k, None, :] for k in range(3))
    own = jnp.where(born[:, None, None], own_cov, 0.0).reshape(capacity * size, size)
    own = jnp.concatenate([jnp.zeros((3, size), joint.cov.dtype), own])
    for k in range(size):
        rows = rows + jnp.where(_same_slot(capacity, size, k), own[:, k, None], 0.0)
    cov = jnp.where(new[:, None], rows, joint.cov)
    cov = jnp.where(new[None, :], jnp.where(new[:, None], 0.5 * (rows + rows.T), rows.T), cov)
    return joint._replace(
        landmarks=jnp.where(born[:, None], landmarks, joint.landmarks),
        cov=cov,
        alive=joint.alive | born,
        tag=jnp.where(born, tag, joint.tag).astype(jnp.int32),
    )


def remove(joint: Joint, dead: jax.Array) -> Joint:
    """Forget the landmarks of the slots dead (N,) bool: marginalize them out and free their slots.

    In covariance form the marginal is what is left when rows and columns are dropped (Solà Table 1,
    state reduction); here they are overwritten with padding. Removing a dead slot changes nothing.
    """
    size = joint.landmarks.shape[1]
    keep = coordinates(~dead, size, robot=True)
    eye = jnp.eye(joint.cov.shape[0], dtype=joint.cov.dtype)
    return joint._replace(
        landmarks=jnp.where(dead[:, None], 0.0, joint.landmarks),
        cov=jnp.where(keep[:, None] & keep[None, :], joint.cov, eye),
        alive=joint.alive & ~dead,
        tag=jnp.where(dead, -1, joint.tag),
    )


def coordinates(slots: jax.Array, landmark_size: int, *, robot: bool) -> jax.Array:
    """The mask (D,) of state coordinates of a mask (N,) of slots; the robot's three as `robot`."""
    return jnp.concatenate([jnp.full(3, robot), jnp.repeat(slots, landmark_size)])


def _same_slot(capacity: int, size: int, k: int) -> jax.Array:
    """(D, D) one where the column is coordinate k of the row's slot."""
    slot_of = jnp.concatenate([jnp.full(3, -1), jnp.repeat(jnp.arange(capacity), size)])
    is_k = jnp.concatenate([jnp.full(3, False), jnp.tile(jnp.arange(size) == k, capacity)])
    return (slot_of[:, None] == slot_of[None, :]) & is_k[None, :]
