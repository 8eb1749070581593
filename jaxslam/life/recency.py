"""When each landmark came and was last seen, for filters that look after loops."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.math.linalg import check_count
from jaxslam.protocols import Life
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Status

Array = jax.Array


class Recency(NamedTuple):
    """Times in scans since the beginning; zero where dead."""

    now: Array
    """() int: the scans so far"""
    born: Array
    """(N,) int: when it entered the map"""
    last: Array
    """(N,) int: when it was last measured"""
    seen: Array
    """(N,) int: scans that measured it"""


def recency(patience: int | None = None) -> Life:
    """When each landmark was born and last measured, and nothing that was seen long ago.

    Args:
        patience: a landmark not measured for so many scans, empty ones too, is removed: the map is
            what is about the robot. None removes no landmark.
    Raises:
        ValueError: on a patience below 1.
    """
    if patience is not None:
        check_count("recency: patience", patience)

    def init(pose: Array, landmarks: Array) -> Recency:
        none = jnp.zeros(landmarks.shape[0], jnp.int32)
        return Recency(jnp.zeros((), jnp.int32), none, none, none)

    def after(joint: Joint, info: Info, estimate: Callable[[], Estimate]) -> tuple[Recency, Array]:
        known: Recency = joint.life
        now = known.now + 1
        count = len(joint.alive)
        born = slots.concerned(info.slot, info.status == Status.BORN, count)
        hit = born | slots.concerned(info.slot, info.status == Status.FUSED, count)
        zero = jnp.zeros_like(known.last)
        memory = Recency(
            now,
            jnp.where(born, now, jnp.where(joint.alive, known.born, zero)),
            jnp.where(hit, now, jnp.where(joint.alive, known.last, zero)),
            jnp.where(born, 1, jnp.where(joint.alive, known.seen + hit, zero)),
        )
        if patience is None:
            return memory, jnp.zeros_like(joint.alive)
        return memory, joint.alive & (now - memory.last >= patience)

    return Life("recency", init, after)
