"""The state of `DelayedSlam`: landmarks, hypotheses and stored measurements in one joint Gaussian.

All three are rows of the landmark table of one `slots.Joint`, three parameters in each slot:

                          slot              mean               covariance P (D, D)
                                        ┌───────────┐    ┌─────┬─────┬─────┬─────┐
    robot                               │ x   y   θ │    │  ·  │  ·  │  ·  │  ·  │
                                        ├───────────┤    ├─────┼─────┼─────┼─────┤
    landmark              0 … N-1       │ x   y   - │    │  ·  │  ·  │  ·  │  ·  │
                                        ├───────────┤    ├─────┼─────┼─────┼─────┤
    hypothesis            N … N+C-1     │ x   y   - │    │  ·  │  ·  │  ·  │  ·  │
                                        ├───────────┤    ├─────┼─────┼─────┼─────┤
    stored measurement    N+C … S-1     │ x   y   q │    │  ·  │  ·  │  ·  │  ·  │
                                        └───────────┘    └─────┴─────┴─────┴─────┘

with S = N + C + W slots and D = 3 + 3 S. A stored measurement is the sensor's position (x, y) and
the measurement q, a direction [rad] or a distance [m], in the map's frame (`triangulation`). The
third parameter of a point is padding (-). P is a full matrix, so the noise of a measurement in
several intersections is one variable, and is never counted as independent.

The processing of a measurement without a landmark in the map:

    measurement ──► stored measurement ──► hypothesis ──► landmark
            stored             two intersect       confirmed often enough; made of all its stored
                                                   measurements, which then leave the table
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.slots import Joint
from jaxslam.math._xla import where_any

SIZE = 3
"""parameters of a slot"""


class TableLayout(NamedTuple):
    """The number of slots of each kind in the table, in this order."""

    landmarks: int
    """N"""
    hypotheses: int
    """C"""
    stored: int
    """W"""

    @property
    def slots(self) -> int:
        """The number of slots of the whole table."""
        return self.landmarks + self.hypotheses + self.stored

    @property
    def first_stored(self) -> int:
        """The slot of the first stored measurement."""
        return self.landmarks + self.hypotheses

    @property
    def of_landmarks(self) -> slice:
        """The slots of landmarks."""
        return slice(0, self.landmarks)

    @property
    def of_hypotheses(self) -> slice:
        """The slots of hypotheses."""
        return slice(self.landmarks, self.first_stored)

    @property
    def of_stored(self) -> slice:
        """The slots of stored measurements."""
        return slice(self.first_stored, self.slots)

    @property
    def hypothesis_rows(self) -> slice:
        """The rows of P that hypotheses own."""
        return slice(3 + SIZE * self.landmarks, 3 + SIZE * self.first_stored)

    @property
    def hypothesis_slots(self) -> Int[Array, "C"]:
        """The slot numbers of hypotheses."""
        return self.landmarks + jnp.arange(self.hypotheses)

    @property
    def stored_slots(self) -> Int[Array, "W"]:
        """The slot numbers of stored measurements."""
        return self.first_stored + jnp.arange(self.stored)


class DelayedCounts(NamedTuple):
    """Counts of deletions, refusals and promotions since the start, () int each."""

    evicted: Int[Array, ""]
    """stored measurements that were marginalized out as the oldest of a full table"""
    refused: Int[Array, ""]
    """intersections refused because all slots of hypotheses were in use"""
    vanished: Int[Array, ""]
    """hypotheses deleted because they were not confirmed often enough"""
    rivals: Int[Array, ""]
    """hypotheses deleted because a hypothesis that excludes them was promoted"""
    promoted: Int[Array, ""]
    """hypotheses that became landmarks"""
    refuted: Int[Array, ""]
    """hypotheses deleted instead of promoted: their stored measurements contradict each other"""


class DelayedState(NamedTuple):
    """The table, and the records of its stored measurements and hypotheses."""

    joint: Joint
    """robot, landmarks, hypotheses and stored measurements, as in the diagram above"""
    clock: Int[Array, ""]
    """number of processed scans"""
    taken_at: Int[Array, "W"]
    """the scan (`clock`) of each stored measurement"""
    z: Float[Array, "W 1"]
    """each stored measurement as the sensor gave it"""
    by_z: Float[Array, "W"]
    """∂q/∂z"""
    persistence: Float[Array, "C"]
    """1 at the start of a hypothesis, plus 1 for each confirmation, less the decay"""
    confirmed_at: Int[Array, "C"]
    """the scan that formed each hypothesis or confirmed it last"""
    group: Int[Array, "C"]
    """number of a group of hypotheses that exclude each other"""
    parents: Int[Array, "C 2"]
    """slots of the two stored measurements of each hypothesis, -1 for one that was deleted"""
    counts: DelayedCounts


class NewMeasurements(NamedTuple):
    """The M measurements of a scan, and which of them have no landmark in the map."""

    z: Float[Array, "M 1"]
    tag: Int[Array, "M"]
    """only measurements of one tag intersect; -1 throughout where identities are unknown"""
    landmark_tag: Int[Array, "M"]
    """the tag that a landmark would get"""
    is_new: Bool[Array, "M"]
    """the measurement has no landmark in the map"""
    repeated: Bool[Array, "M"]
    """the measurement is new, and an earlier new one of the scan has the same tag"""

    @property
    def wanted(self) -> Bool[Array, "M"]:
        """Mask of the measurements that are new and not repeated."""
        return self.is_new & ~self.repeated


def empty_state(
    layout: TableLayout, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]
) -> DelayedState:
    """The initial state: the robot and nothing else."""
    none = jnp.asarray(0, jnp.int32)
    ints = jnp.zeros(layout.hypotheses, jnp.int32)
    return DelayedState(
        joint=slots.empty(pose, pose_cov, layout.slots, SIZE),
        clock=none,
        taken_at=jnp.zeros(layout.stored, jnp.int32),
        z=jnp.zeros((layout.stored, 1), pose.dtype),
        by_z=jnp.ones(layout.stored, pose.dtype),
        persistence=jnp.zeros(layout.hypotheses, pose.dtype),
        confirmed_at=ints,
        group=ints,
        parents=jnp.full((layout.hypotheses, 2), -1, jnp.int32),
        counts=DelayedCounts(none, none, none, none, none, none),
    )


def covariance_blocks(joint: Joint) -> Float[Array, "S 3 S 3"]:
    """The covariance of the table by slots, without the robot."""
    capacity = joint.alive.shape[0]
    # Slot and parameter of the row, slot and parameter of the column.
    return joint.cov[3:, 3:].reshape(capacity, SIZE, capacity, SIZE)


def covariance_rows(joint: Joint) -> Float[Array, "S 3 D"]:
    """The rows of P of each slot, with the robot's columns first."""
    return joint.cov[3:].reshape(joint.alive.shape[0], SIZE, -1)


def slots_where(
    layout: TableLayout,
    *,
    hypotheses: Bool[Array, "C"] | None = None,
    stored: Bool[Array, "W"] | None = None,
) -> Bool[Array, "S"]:
    """The mask of all slots, from masks of hypotheses and of stored measurements."""
    mask = jnp.zeros(layout.slots, bool)
    if hypotheses is not None:
        mask = mask.at[layout.of_hypotheses].set(hypotheses)
    if stored is not None:
        mask = mask.at[layout.of_stored].set(stored)
    return mask


def delete_slots(layout: TableLayout, state: DelayedState, dead: Bool[Array, "S"]) -> DelayedState:
    """The state with these slots marginalized out, and removed from the parents of hypotheses."""
    parents = state.parents
    # -1, for no parent, becomes index 0; what is read there is masked.
    orphaned = (parents >= 0) & dead[jnp.maximum(parents, 0)]
    persistence = jnp.where(dead[layout.of_hypotheses], 0.0, state.persistence)
    return state._replace(
        joint=slots.remove(state.joint, dead),
        parents=jnp.where(orphaned, -1, parents),
        persistence=persistence,
    )


def delete_slots_if_any(
    layout: TableLayout, state: DelayedState, dead: Bool[Array, "S"]
) -> DelayedState:
    """`delete_slots`, skipped if no run of a batch deletes a slot."""
    return where_any(dead.any(), lambda s: delete_slots(layout, s, dead), lambda s: s, state)


def is_newer(time: Int[Array, "W"]) -> Bool[Array, "W W"]:
    """Mask [i, j]: stored measurement j is later than i; at equal times, j > i.

    The sum of a row is the rank of i from the newest, which compiles faster than two sorts.
    """
    place = jnp.arange(len(time))
    later = time[None, :] > time[:, None]
    return later | ((time[None, :] == time[:, None]) & (place[None, :] > place[:, None]))


def add_to(count: Int[Array, ""], mask: Bool[Array, "..."]) -> Int[Array, ""]:
    """A count plus the number of set entries of a mask."""
    return count + mask.sum(dtype=jnp.int32)
