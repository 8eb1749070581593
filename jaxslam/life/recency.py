"""Removal of landmarks by the time since their last measurement."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam import slots
from jaxslam.core.numbers import check_count
from jaxslam.core.record import record, static
from jaxslam.protocols import Life
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Status


class Times(NamedTuple):
    """Times of the first and last measurement of each landmark, in scans; zero where dead."""

    now: Int[Array, ""]
    """the scans so far"""
    born: Int[Array, "N"]
    """when it was initialized"""
    last: Int[Array, "N"]
    """when it was last measured"""
    seen: Int[Array, "N"]
    """scans that measured it"""


@record
class Recency(Life):
    """The rule that removes landmarks not measured for long; `Closing` reads the times it keeps.

    Raises ValueError on a patience below 1.
    """

    patience: int | None = static(default=None)
    """a landmark not measured for so many scans, empty ones too, is removed, so that a local map is
    left. None removes no landmark."""

    def __post_init__(self) -> None:
        if self.patience is not None:
            check_count("Recency: patience", self.patience)
        super().__post_init__()

    def init(self, pose: Float[Array, "3"], landmarks: Float[Array, "N L"]) -> Times:
        none = jnp.zeros(landmarks.shape[0], jnp.int32)
        return Times(jnp.zeros((), jnp.int32), none, none, none)

    def after(
        self, joint: Joint, info: Info, estimate: Callable[[], Estimate]
    ) -> tuple[Times, Bool[Array, "N"]]:
        known: Times = joint.life
        now = known.now + 1
        count = len(joint.alive)
        born = slots.concerned(info.slot, info.status == Status.BORN, count)
        hit = born | slots.concerned(info.slot, info.status == Status.FUSED, count)
        zero = jnp.zeros_like(known.last)
        memory = Times(
            now,
            jnp.where(born, now, jnp.where(joint.alive, known.born, zero)),
            jnp.where(hit, now, jnp.where(joint.alive, known.last, zero)),
            jnp.where(born, 1, jnp.where(joint.alive, known.seen + hit, zero)),
        )
        if self.patience is None:
            return memory, jnp.zeros_like(joint.alive)
        return memory, joint.alive & (now - memory.last >= self.patience)
