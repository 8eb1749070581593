"""The fixed-capacity map: a joint Gaussian over the robot and N landmark slots.

The padding invariant: a dead slot has zero mean, zero cross-covariance, unit variance and tag -1.
So the covariance is positive definite if its alive part is, and every product with a dead slot's
rows is zero: padding has no effect, and the filter's equations need no mask.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.core._reprs import short_repr
from jaxslam.core.validation import InvalidField
from jaxslam.math._linalg import cholesky, matmul, symmetrize, total, triangular_root
from jaxslam.math._xla import CACHED, last_true_column, materialize, where_any

__all__ = [
    "Joint",
    "allocate",
    "empty",
    "find",
    "gather",
    "local_cov",
    "remove",
    "robot_cov",
    "scatter",
    "seen_before",
    "slot_mask",
]


class Joint(NamedTuple):
    """The joint state (Solà (5), (6)); D = R + N·L, slot i owns rows R + i·L to R + (i+1)·L.

    The robot has R = 3 + E numbers, its pose and `further` ones; R = `robot_size`.
    """

    pose: Float[Array, "3"]
    landmarks: Float[Array, "N L"]
    cov: Float[Array, "D D"]
    """covariance of the error in the filter's chart, robot first; of a square-root filter a
    root X of it, X Xᵀ = P"""
    alive: Bool[Array, "N"]
    tag: Int[Array, "N"]
    """-1 where dead"""
    lin: PyTree
    """the linearizer's memory"""
    life: PyTree = None
    """the memory of a `Life`, of a filter that is pruned"""
    reduced: PyTree = None
    """(N,) bool: the slot holds a point (x, y), and padding in the rest of its L coordinates; of
    a sensor whose landmarks may become points"""
    co_observed: jax.Array | None = None
    """(N, N) bool: pairs of landmarks that one scan measured, of a filter that merges others"""
    further: jax.Array | None = None
    """(E,) further numbers of the robot, `Motion.state[3:]`; None where its state is the pose"""

    @property
    def robot(self) -> Float[Array, "R"]:
        """The pose and further numbers of the robot."""
        if self.further is None:
            return self.pose
        return jnp.concatenate([self.pose, self.further], axis=-1)

    @property
    def robot_size(self) -> int:
        """The number R of the robot's numbers, and so of its rows of P."""
        return 3 if self.further is None else 3 + self.further.shape[-1]

    def with_robot(self, robot: Float[Array, "R"]) -> "Joint":
        """The state with these numbers of the robot."""
        if robot.shape[-1] == 3:
            return self._replace(pose=robot)
        return self._replace(pose=robot[..., :3], further=robot[..., 3:])

    def __repr__(self) -> str:
        return short_repr(self)


def empty(
    pose: Float[Array, "R"],
    pose_cov: Float[Array, "R R"],
    capacity: int,
    landmark_size: int,
    lin: PyTree = (),
    *,
    square_root: bool = False,
) -> Joint:
    """The initial state: a robot and no landmark (Solà (7)); pose_cov (R, R) may be zero."""
    n = pose.shape[0]
    size = n + capacity * landmark_size
    if square_root:
        pose_cov = cholesky(pose_cov)[0]
    return Joint(
        pose=pose,
        landmarks=jnp.zeros((capacity, landmark_size), pose.dtype),
        cov=jnp.eye(size, dtype=pose.dtype).at[:n, :n].set(pose_cov),
        alive=jnp.zeros(capacity, bool),
        tag=jnp.full(capacity, -1, jnp.int32),
        lin=lin,
    ).with_robot(pose)


def find(
    tag: Int[Array, "N"], alive: Bool[Array, "N"], wanted: Int[Array, "M"]
) -> tuple[Int[Array, "M"], Bool[Array, "M"]]:
    """The slot (M,) of each wanted tag (M,), 0 without one, and a mask of the slots found (M,)."""
    return last_true_column((wanted[:, None] == tag[None, :]) & alive[None, :])


def allocate(
    alive: Bool[Array, "N"], wanted: Bool[Array, "M"]
) -> tuple[Int[Array, "M"], Bool[Array, "M"]]:
    """A free slot for each measurement that needs one: the first gets the lowest, and so on.

    alive (N,) and wanted (M,) bool -> slot (M,) int32, 0 where none, and granted (M,) bool.
    """
    free = ~alive
    rank_of_slot = jnp.where(free, jnp.cumsum(free), 0)
    rank_of_wish = jnp.where(wanted, jnp.cumsum(wanted), -1)
    return last_true_column(rank_of_wish[:, None] == rank_of_slot[None, :])


def seen_before(tag: Int[Array, "M"], among: Bool[Array, "M"]) -> Bool[Array, "M"]:
    """Whether a tag (M,), if not negative, occurs earlier in the scan among the tags (M,)."""
    earlier = jnp.tril(jnp.ones((tag.shape[0], tag.shape[0]), bool), -1)
    same = (tag[:, None] == tag[None, :]) & (tag >= 0)[:, None] & among[None, :]
    return (same & earlier).any(axis=1)


def slot_mask(slot: Int[Array, "M"], on: Bool[Array, "M"], count: int) -> Bool[Array, "N"]:
    """Mask (count,) of the slots that occur in slot (M,) where on (M,)."""
    return jnp.zeros(count, bool).at[jnp.where(on, slot, count)].set(True, mode="drop")


def gather(joint: Joint, slot: Int[Array, ""]) -> tuple[Float[Array, "L"], Float[Array, "L D"]]:
    """The landmark (L,) in a slot () and its rows (L, D) of the covariance."""
    size = joint.landmarks.shape[1]
    landmark = jax.lax.dynamic_index_in_dim(joint.landmarks, slot, keepdims=False)
    return landmark, jax.lax.dynamic_slice_in_dim(joint.cov, joint.robot_size + slot * size, size)


def robot_cov(joint: Joint, square_root: bool = False) -> Float[Array, "R R"]:
    """The covariance of the robot, (R, R)."""
    n = joint.robot_size
    return joint.cov[:n] @ joint.cov[:n].T if square_root else joint.cov[:n, :n]


def local_cov(joint: Joint, slot: Int[Array, ""], square_root: bool = False) -> Float[Array, "K K"]:
    """The covariance of the robot and the landmark of a slot (), (R+L, R+L)."""
    n, size = joint.robot_size, joint.landmarks.shape[1]
    rows = jnp.concatenate([joint.cov[:n], gather(joint, slot)[1]])
    if square_root:
        return rows @ rows.T
    landmark = jax.lax.dynamic_slice_in_dim(rows, n + slot * size, size, axis=1)
    return jnp.concatenate([rows[:, :n], landmark], axis=1)


def scatter(
    joint: Joint,
    slot: Int[Array, "M"],
    granted: Bool[Array, "M"],
    landmarks: Float[Array, "M L"],
    by_pose: Float[Array, "M L R"],
    own_cov: Float[Array, "M L L"],
    tag: Int[Array, "M"],
    *,
    square_root: bool = False,
) -> Joint:
    """The joint with m landmarks in dead slots, correlated through the pose: Solà (35)-(38).

    With G the stacked by_pose: P_LR = G P_RR, P_LM = G P_RM, P_LL = G P_RR Gᵀ + diag(own_cov).
    So the landmarks of one scan are correlated with each other through the robot. Their rows and
    columns are written in place, O(N) a landmark; in a small map, whose P stays in the cache, by
    one pass over P, which is faster in a batch. Those not granted change nothing.
    Of a square root X, X_L = G X_R beside a root of own_cov in the columns of the slot.

    Args:
        slot: (m,) dead slots, all different where granted.
        granted: (m,) bool.
        landmarks, by_pose, own_cov, tag: (m, L), (m, L, R), (m, L, L), (m,).
    """
    m, size = landmarks.shape
    capacity = joint.landmarks.shape[0]
    if m == 0:
        return joint
    # Stored: each of them is in many of the D² entries of P, and would be computed again for each.
    landmarks, by_pose, own_cov = materialize((landmarks, by_pose, own_cov))
    # By slot: the index it is filled from.
    place, born = last_true_column(
        granted[None, :] & (slot[None, :] == jnp.arange(capacity, dtype=slot.dtype)[:, None])
    )

    def of_slots(values: jax.Array) -> jax.Array:
        mask = born.reshape(-1, *(1,) * (values.ndim - 1))
        return jnp.where(mask, values[place], jnp.zeros_like(values[:1]))

    gain = of_slots(by_pose).reshape(capacity * size, joint.robot_size)
    landmark_cov = of_slots(symmetrize(own_cov))
    if square_root:
        landmark_cov = jax.vmap(lambda cov: cholesky(cov)[0])(landmark_cov)
    if len(joint.cov) <= CACHED:
        cov = _add_in_one_pass(joint.cov, born, gain, landmark_cov, square_root)
    else:
        cov = _write_in_place(joint.cov, slot, granted, gain, landmark_cov, square_root)
    return joint._replace(
        landmarks=joint.landmarks + of_slots(landmarks),
        cov=cov,
        alive=joint.alive | born,
        tag=jnp.where(born, tag[place], joint.tag).astype(jnp.int32),
    )


def _half_of(cov: Float[Array, "D D"], gain: Float[Array, "E R"]) -> Float[Array, "R D"]:
    """T = R + P_RR Gᵀ/2 of the rows R of the robot, which are zero at the new columns.

    G T + (G T)ᵀ is the cross-covariance with the map and, where rows and columns are both new,
    G P_RR Gᵀ; symmetric to the bit.
    """
    n = gain.shape[1]
    return cov[:n].at[:, n:].add(0.5 * matmul(cov[:n, :n], gain.T))


def _add_in_one_pass(
    cov: Float[Array, "D D"],
    born: Bool[Array, "N"],
    gain: Float[Array, "E R"],
    landmark_cov: Float[Array, "N L L"],
    square_root: bool,
) -> Float[Array, "D D"]:
    """The covariance with G P and blocks on the diagonal added to the zeros of padding."""
    # Padding's unit variance goes first, to an exact zero: a small covariance plus 1 would lose it.
    n = gain.shape[1]
    filled = jnp.concatenate([jnp.zeros(n, bool), jnp.repeat(born, landmark_cov.shape[1])])
    half = cov[:n] if square_root else _half_of(cov, gain)
    cov = jnp.where(filled[:, None], 0.0, cov)
    cross = total(gain[:, k, None] * half[k, None, :] for k in range(n))
    if square_root:
        return _add_blocks(cov.at[n:].add(cross), landmark_cov)
    # Stored once: XLA would compute it again for its transpose, at each of the D² entries.
    cross = materialize(jnp.pad(cross, [(n, 0), (0, 0)]))
    return _add_blocks(cov + (cross + cross.T), landmark_cov)


def _write_in_place(
    cov: Float[Array, "D D"],
    slot: Int[Array, "m"],
    granted: Bool[Array, "m"],
    gain: Float[Array, "E R"],
    landmark_cov: Float[Array, "N L L"],
    square_root: bool,
) -> Float[Array, "D D"]:
    """The covariance of `_add_in_one_pass`, written one new landmark after the other."""
    size, n = landmark_cov.shape[1], gain.shape[1]
    # Before the loop: the rows of the robot change as landmarks are written.
    half = materialize(cov[:n] if square_root else _half_of(cov, gain))

    def write(cov: jax.Array, slot: jax.Array, granted: jax.Array) -> jax.Array:
        first = n + slot * size
        by_pose = jax.lax.dynamic_slice_in_dim(gain, slot * size, size)
        rows = total(by_pose[:, k, None] * half[k, None, :] for k in range(n))
        if not square_root:
            columns = jax.lax.dynamic_slice_in_dim(half, first, size, axis=1)
            rows = rows.at[:, n:].add(
                total(columns[k, :, None] * gain[None, :, k] for k in range(n))
            )
        block = jax.lax.dynamic_slice_in_dim(rows, first, size, axis=1) + landmark_cov[slot]
        # Stored, since the rows are written twice: as rows, and transposed as columns.
        rows = materialize(jax.lax.dynamic_update_slice_in_dim(rows, block, first, axis=1))
        for values, axis in ((rows, 0),) if square_root else ((rows, 0), (rows.T, 1)):
            # A run of a batch in which this landmark is not granted gets back what it had.
            before = jax.lax.dynamic_slice_in_dim(cov, first, size, axis)
            values = jnp.where(granted, values, before)
            cov = jax.lax.dynamic_update_slice_in_dim(cov, values, first, axis)
        return cov

    def step(cov: jax.Array, landmark: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        _, granted = landmark
        return where_any(granted, lambda cov: write(cov, *landmark), lambda cov: cov, cov), None

    return jax.lax.scan(step, cov, (slot, granted))[0]


def _add_blocks(cov: Float[Array, "D D"], blocks: Float[Array, "N L L"]) -> Float[Array, "D D"]:
    """The covariance with blocks (N, L, L) added on the diagonal of the landmarks."""
    capacity, size = blocks.shape[:2]
    first = cov.shape[0] - capacity * size  # R, after the rows of the robot
    rows = first + jnp.arange(capacity)[:, None] * size + jnp.arange(size)[None, :]
    return cov.at[rows[:, :, None], rows[:, None, :]].add(blocks)


def remove(joint: Joint, dead: Array, *, square_root: bool = False) -> Joint:
    """The joint with the landmarks of the slots dead (N,) bool marginalized out and the slots free.

    In covariance form the marginal is P without the rows and columns (Solà Table 1,
    state reduction); here they are overwritten with padding. Removing a dead slot changes nothing.
    square_root: the state holds a root of P, as in a filter with covariance="square_root".

    Raises ValueError unless dead is bool, one for each slot.
    """
    if jnp.shape(dead) != joint.alive.shape or jnp.result_type(dead) != jnp.bool_:
        got = f"{jnp.result_type(dead)} of {jnp.shape(dead)}"
        reason = f"expected bool of shape {joint.alive.shape}, got {got}"
        raise InvalidField("dead", reason, owner="remove")
    size = joint.landmarks.shape[1]
    keep = jnp.concatenate([jnp.ones(joint.robot_size, bool), jnp.repeat(~dead, size)])
    eye = jnp.eye(joint.cov.shape[0], dtype=joint.cov.dtype)
    if square_root:
        wide = [jnp.where(keep[:, None], joint.cov, 0.0), jnp.where(keep[:, None], 0.0, eye)]
        cov = triangular_root(jnp.concatenate(wide, axis=1))
    else:
        cov = jnp.where(keep[:, None] & keep[None, :], joint.cov, eye)
    return joint._replace(
        landmarks=jnp.where(dead[:, None], 0.0, joint.landmarks),
        cov=cov,
        alive=joint.alive & ~dead,
        tag=jnp.where(dead, -1, joint.tag),
        reduced=jax.tree.map(lambda is_point: is_point & ~dead, joint.reduced),
        co_observed=jax.tree.map(
            lambda pairs: pairs & ~dead[:, None] & ~dead[None, :], joint.co_observed
        ),
    )
