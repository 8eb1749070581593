"""Removal of landmarks by the time since their last measurement."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam import slots
from jaxslam.core.numbers import check_count
from jaxslam.protocols import Life
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Status


class Recency(NamedTuple):
    """Times of the first and last measurement of each landmark, in scans; zero where dead."""

    now: Int[Array, ""]
    """the scans so far"""
    born: Int[Array, "N"]
    """when it was initialized"""
    last: Int[Array, "N"]
    """when it was last measured"""
    seen: Int[Array, "N"]
    """scans that measured it"""


def recency(patience: int | None = None) -> Life:
    """The rule that removes landmarks not measured for long; `closing` reads the times it keeps.

    Args:
        patience: a landmark not measured for so many scans, empty ones too, is removed, so that
            a local map is left. None removes no landmark.
    Raises:
        ValueError: on a patience below 1.
    """
    if patience is not None:
        check_count("recency: patience", patience)

    def init(pose: Float[Array, "3"], landmarks: Float[Array, "N L"]) -> Recency:
        none = jnp.zeros(landmarks.shape[0], jnp.int32)
        return Recency(jnp.zeros((), jnp.int32), none, none, none)

    def after(
        joint: Joint, info: Info, estimate: Callable[[], Estimate]
    ) -> tuple[Recency, Bool[Array, "N"]]:
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
