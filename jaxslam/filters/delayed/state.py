"""The state of `delayed_slam`: one table of landmarks, hypotheses and sightings."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.filters.delayed.triangulation import Meeting
from jaxslam.protocols import Sensor
from jaxslam.slots import Joint

Array = jax.Array
Distance = Literal["mahalanobis", "bhattacharyya"]

SIZE = 3
"""parameters of a slot"""


class Layout(NamedTuple):
    """How many slots of each kind, in their order."""

    landmarks: int
    hypotheses: int
    sightings: int

    @property
    def slots(self) -> int:
        """of the whole table."""
        return self.landmarks + self.hypotheses + self.sightings

    @property
    def first_sighting(self) -> int:
        """its slot."""
        return self.landmarks + self.hypotheses

    @property
    def of_landmarks(self) -> slice:
        """their slots."""
        return slice(0, self.landmarks)

    @property
    def of_hypotheses(self) -> slice:
        """their slots."""
        return slice(self.landmarks, self.first_sighting)

    @property
    def of_sightings(self) -> slice:
        """their slots."""
        return slice(self.first_sighting, self.slots)

    @property
    def hypothesis_slots(self) -> Array:
        """(C,) the same as numbers."""
        return self.landmarks + jnp.arange(self.hypotheses)

    @property
    def sighting_slots(self) -> Array:
        """(W,) the same as numbers."""
        return self.first_sighting + jnp.arange(self.sightings)


class Rules(NamedTuple):
    """What `delayed_slam` was told; see there."""

    layout: Layout
    sensor: Sensor
    meeting: Meeting
    tagged: bool
    """sightings meet those of their tag only"""
    gate: float
    spacing: float
    spread: float
    ready: float
    distance: Distance
    same: float
    persistence: float
    decay: float
    lead: float
    patience: int


class Counts(NamedTuple):
    """What the tables lost or gave up, () int each, since the start."""

    evicted: Array
    """sightings that left the full table as the oldest, by marginalization"""
    refused: Array
    """intersections that found the table of hypotheses full"""
    vanished: Array
    """hypotheses that were not confirmed often enough"""
    rivals: Array
    """hypotheses that ended with the promotion of another"""
    promoted: Array
    """hypotheses that became landmarks"""
    refuted: Array
    """hypotheses that ended at their promotion: their sightings do not fit together"""


class Delayed(NamedTuple):
    """The state: a table of landmarks, hypotheses and sightings, and how these stand."""

    joint: Joint
    """landmarks first, then hypotheses, then sightings; see `filters.hypotheses`"""
    clock: Array
    """() int: scans so far"""
    taken: Array
    """(W,) int: the scan that each sighting is of"""
    noise: Array
    """(W,) variance of what each saw [rad² or m²]"""
    persistence: Array
    """(C,) of each hypothesis"""
    confirmed: Array
    """(C,) int: the scan that formed it or confirmed it last"""
    group: Array
    """(C,) int: hypotheses of one group exclude each other"""
    parents: Array
    """(C, 2) int: slots of the sightings it was formed of, -1 for one that left"""
    counts: Counts


class Fresh(NamedTuple):
    """The measurements of a scan that are of no landmark of the map, (M,) each."""

    z: Array
    tag: Array
    fresh: Array
    """bool"""


def empty(layout: Layout, pose: Array, pose_cov: Array) -> Delayed:
    """Nothing but the robot."""
    none = jnp.asarray(0, jnp.int32)
    ints = jnp.zeros(layout.hypotheses, jnp.int32)
    return Delayed(
        joint=slots.empty(pose, pose_cov, layout.slots, SIZE),
        clock=none,
        taken=jnp.zeros(layout.sightings, jnp.int32),
        noise=jnp.zeros(layout.sightings, pose.dtype),
        persistence=jnp.zeros(layout.hypotheses, pose.dtype),
        confirmed=ints,
        group=ints,
        parents=jnp.full((layout.hypotheses, 2), -1, jnp.int32),
        counts=Counts(none, none, none, none, none, none),
    )


def without(layout: Layout, state: Delayed, gone: Array) -> Delayed:
    """Slots gone (S,) bool emptied; their parts in hypotheses are forgotten."""
    parents = state.parents
    orphaned = (parents >= 0) & gone[jnp.maximum(parents, 0)]
    persistence = jnp.where(gone[layout.of_hypotheses], 0.0, state.persistence)
    return state._replace(
        joint=slots.remove(state.joint, gone),
        parents=jnp.where(orphaned, -1, parents),
        persistence=persistence,
    )


def after(when: Array) -> Array:
    """(W, W) bool: whether sighting j was taken after i, when (W,); of one scan, whether j > i.

    A rank is a row's sum: one kernel, where two sorts are more to compile than all else around.
    """
    place = jnp.arange(len(when))
    later = when[None, :] > when[:, None]
    return later | ((when[None, :] == when[:, None]) & (place[None, :] > place[:, None]))


def more(count: Array, these: Array) -> Array:
    """A count () and how many of these more."""
    return count + these.sum(dtype=jnp.int32)
