"""How a robot that is nowhere enters the joint map of a team: of several ways, the sharpest."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import slots
from jaxslam.filters.multi_robot import pose_initialization
from jaxslam.filters.multi_robot.pose_initialization import Entry, Sightings
from jaxslam.protocols import Sensor
from jaxslam.slots import Joint
from jaxslam.team import Robot
from jaxslam.types import Scan

Array = jax.Array

SIZE = 3
"""Numbers of a slot: x, y and the heading of a robot; of a landmark the third is padding."""


def points_seen(robot: Robot, scan: Scan) -> Sightings:
    """What a robot sees in full; places of other sensors are there, and not valid."""
    found, at = [], 0
    for part in robot.sensors.parts:
        own: Scan = jax.tree.map(lambda leaf, a=at, n=part.places: leaf[a : a + n], scan)
        at += part.places
        if sees_in_full(part.sensor):
            z = own.z[:, : len(part.sensor.measurements)]
            found.append(pose_initialization.sightings(part.sensor, z, own.tag, own.valid))
        else:
            m, dtype = part.places, scan.z.dtype
            nothing = jnp.zeros((m, 2), dtype), jnp.zeros((m, 2, 2), dtype)
            found.append(Sightings(*nothing, own.tag, jnp.zeros(m, bool)))
    return Sightings(*(jnp.concatenate(leaves) for leaves in zip(*found, strict=True)))


def sees_in_full(sensor: Sensor) -> bool:
    """Whether one measurement of a point leaves nothing of it free."""
    return len(sensor.landmark) == 2 and np.shape(sensor.free.mean) == (0,)


def best_way(
    joint: Joint,
    capacity: int,
    tags: tuple[int, ...],
    robot: int,
    seen: list[Sightings],
    there: Array,
) -> tuple[Entry, list[Array]]:
    """How a robot enters, and which places (M,) of each robot's sightings that takes."""
    mine = seen[robot]
    ways: list[tuple[Entry, list[Array]]] = []
    unused = [jnp.zeros_like(part.valid) for part in seen]
    for a in range(len(seen)):
        if a == robot:
            continue
        at = (
            slice(0, 3)
            if a == 0
            else slice(3 + (capacity - 1 + a) * SIZE, 3 + (capacity + a) * SIZE)
        )
        pose = joint.pose if a == 0 else joint.landmarks[capacity - 1 + a]
        i, sees = _first(seen[a], tags[robot])
        j, sees_back = _first(mine, tags[a])
        found = pose_initialization.by_mutual_sight(
            pose,
            joint.cov[at],
            joint.cov[at, at],
            (seen[a].point[i], seen[a].cov[i]),
            (mine.point[j], mine.cov[j]),
        )
        used = list(unused)
        used[a] = jnp.arange(len(unused[a])) == i
        used[robot] = jnp.arange(len(unused[robot])) == j
        ways.append((Entry(*found, there[a] & sees & sees_back), used))
    slot, known = slots.find(joint.tag[:capacity], joint.alive[:capacity], mine.tag)
    if len(mine.tag) > 1:
        i, j, two = pose_initialization.farthest_pair(mine.point, known & mine.valid)
        pair, which = jnp.stack([i, j]), jnp.stack([slot[i], slot[j]])
        at_pair = (3 + which[:, None] * SIZE + jnp.arange(2)[None, :]).reshape(-1)
        rows = joint.cov[at_pair]
        found = pose_initialization.by_two_landmarks(
            joint.landmarks[which, :2], rows, rows[:, at_pair], mine.point[pair], mine.cov[pair]
        )
        used = list(unused)
        used[robot] = (jnp.arange(len(mine.tag)) == i) | (jnp.arange(len(mine.tag)) == j)
        ways.append((Entry(*found, two & (which[0] != which[1])), used))
    heading = jnp.stack([jnp.where(way.possible, way.cov[2, 2], jnp.inf) for way, _ in ways])
    best = jnp.argmin(heading)
    entry, used = jax.tree.map(lambda *leaves: jnp.stack(leaves)[best], *ways)
    return entry, used


def _first(seen: Sightings, tag: int) -> tuple[Array, Array]:
    """The first place with a tag, and whether there is one."""
    match = seen.valid & (seen.tag == tag)
    return jnp.argmax(match), match.any()


def entered(joint: Joint, slot: int, entry: Entry, tag: int) -> Joint:
    """The joint with a robot in its (empty) slot."""
    at = slice(3 + slot * SIZE, 3 + (slot + 1) * SIZE)
    cov = joint.cov.at[at].set(entry.rows).at[:, at].set(entry.rows.T).at[at, at].set(entry.cov)
    return joint._replace(
        landmarks=joint.landmarks.at[slot].set(entry.pose),
        cov=cov,
        alive=joint.alive.at[slot].set(True),
        tag=joint.tag.at[slot].set(tag),
    )
