"""Rules that decide after each scan which landmarks stay in the map.

By the time since their last measurement, or by their log-odds of existence.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core.protocols import Life
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Status
from jaxslam.core.validation import InvalidField, at_least, or_none, positive
from jaxslam.math._arrays import Number, is_concrete

__all__ = ["Evidence", "Existence", "Recency", "Times"]


class Times(NamedTuple):
    """Times of the first and last measurement of each landmark, in scans; zero where dead."""

    now: Int[Array, ""]
    """number of processed scans"""
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

    patience: int | None = static(default=None, check=or_none(at_least(1)))
    """a landmark not measured for this many scans, empty ones too, is removed, which leaves a local
    map. None removes no landmark."""

    def init(self, pose: Float[Array, "3"], landmarks: Float[Array, "N L"]) -> Times:
        none = jnp.zeros(landmarks.shape[0], jnp.int32)
        return Times(jnp.zeros((), jnp.int32), none, none, none)

    def after(
        self, joint: Joint, info: Info, estimate: Callable[[], Estimate]
    ) -> tuple[Times, Bool[Array, "N"]]:
        times: Times = joint.life
        now = times.now + 1
        count = len(joint.alive)
        born = slots.slot_mask(info.slot, info.status == Status.BORN, count)
        hit = born | slots.slot_mask(info.slot, info.status == Status.FUSED, count)
        zero = jnp.zeros_like(times.last)
        memory = Times(
            now,
            jnp.where(born, now, jnp.where(joint.alive, times.born, zero)),
            jnp.where(hit, now, jnp.where(joint.alive, times.last, zero)),
            jnp.where(born, 1, jnp.where(joint.alive, times.seen + hit, zero)),
        )
        if self.patience is None:
            return memory, jnp.zeros_like(joint.alive)
        return memory, joint.alive & (now - memory.last >= self.patience)


_LARGEST = 10.0
"""bound of the log-odds, so that a landmark that was measured often is removed after some misses"""


class Evidence(NamedTuple):
    """The evidence for each slot's landmark; zero where dead."""

    log_odds: Float[Array, "N"]
    """log-odds that it exists"""
    confirmed: Bool[Array, "N"]
    """whether its probability has reached `confirm`; before that it is provisional"""
    seen: Int[Array, "N"]
    """scans that measured it"""
    missed: Int[Array, "N"]
    """scans that should have measured it, and did not"""
    since: Int[Array, "N"]
    """scans since it was last measured"""


@record
class Existence(Life):
    """The rule that keeps and removes landmarks by their log-odds of existence.

    These are updated as those of an occupancy map's cell (Thrun, Burgard, Fox, "Probabilistic
    Robotics", 2005, sections 9.2 and 13.9, where landmarks are removed by negative evidence).

    A landmark begins at even odds. Each scan that measures it adds log(detected/false), each that
    should have and does not adds log((1 - detected)/(1 - false)). Where the probability comes to
    `confirm` it is confirmed permanently, where it falls to `remove` it is removed from the map.
    Provisional landmarks are corrected as all others are.

    Raises ValueError on a visible that is no function; unless 0 < false < detected < 1 and
    0 < remove < 1/2 < confirm < 1; on a patience below 1 or a spread not above 0.
    """

    visible: Callable[[Array, Array], Array] = field(check=function_of("pose", "l"))
    """(pose, l) -> () bool: whether a scan from there should measure the landmark. Prefer a strict
    one: a sensor misses many landmarks near the edge of its view."""
    _: dataclasses.KW_ONLY
    detected: Number = 0.9
    """probability that a scan measures a visible landmark, P(seen | there)"""
    false: Number = 0.1
    """probability that a scan measures a landmark that is not there, P(seen | not there)"""
    confirm: Number = 0.95
    """probability from which a landmark is confirmed"""
    remove: Number = 0.05
    """probability down to which a landmark is kept"""
    patience: int | None = static(default=None, check=or_none(at_least(1)))
    """a provisional landmark not measured for this many scans is removed"""
    spread: Number | None = field(default=None, check=or_none(positive))
    """[m] a landmark with a larger standard deviation, √(tr P/2), is removed"""
    replace: bool = static(default=False)
    """in a full map, new landmarks take the place of those least likely to exist among the
    provisional ones that the scan did not measure; otherwise the map refuses
    (`Status.OVERFLOW`)"""

    def __post_init__(self) -> None:
        false, detected, remove, confirm = self.false, self.detected, self.remove, self.confirm
        if is_concrete(false, detected) and not 0 < false < detected < 1:
            reason = f"expected 0 < false < detected < 1, got {false}, {detected}"
            raise InvalidField("", reason)
        if is_concrete(remove, confirm) and not 0 < remove < 0.5 < confirm < 1:
            reason = f"expected 0 < remove < 1/2 < confirm < 1, got {remove}, {confirm}"
            raise InvalidField("", reason)
        super().__post_init__()

    def init(self, pose: Float[Array, "3"], landmarks: Float[Array, "N L"]) -> Evidence:
        capacity = landmarks.shape[0]
        none = jnp.zeros(capacity, jnp.int32)
        return Evidence(
            jnp.zeros(capacity, pose.dtype), jnp.zeros(capacity, bool), none, none, none
        )

    def after(
        self, joint: Joint, info: Info, estimate: Callable[[], Estimate]
    ) -> tuple[Evidence, Bool[Array, "N"]]:
        count = len(joint.alive)
        born = slots.slot_mask(info.slot, info.status == Status.BORN, count)
        hit = born | slots.slot_mask(info.slot, info.status == Status.FUSED, count)
        evidence: Evidence = joint.life
        old = jax.tree.map(lambda x: jnp.where(born | ~joint.alive, jnp.zeros_like(x), x), evidence)
        view = jax.vmap(self.visible, (None, 0))(joint.pose, joint.landmarks)
        expected = joint.alive & ~hit & view
        dtype = old.log_odds.dtype
        detected, false = jnp.asarray(self.detected, dtype), jnp.asarray(self.false, dtype)
        gain, loss = jnp.log(detected / false), jnp.log((1 - detected) / (1 - false))
        change = jnp.where(hit & ~born, gain, 0.0) + jnp.where(expected, loss, 0.0)
        odds = jnp.clip(old.log_odds + change, -_LARGEST, _LARGEST)
        confirmed = joint.alive & (old.confirmed | (odds >= _log_odds(self.confirm, dtype)))
        since = jnp.where(hit | ~joint.alive, 0, old.since + 1)
        dead = odds <= _log_odds(self.remove, dtype)
        if self.patience is not None:
            dead = dead | (~confirmed & (since >= self.patience))
        if self.spread is not None:
            variance = jnp.trace(estimate().point_covs, axis1=1, axis2=2) / 2
            dead = dead | (variance > self.spread**2)
        memory = Evidence(
            odds, confirmed, old.seen + hit, old.missed + expected, since.astype(jnp.int32)
        )
        return memory, dead & joint.alive

    @property
    def make_room(self) -> Callable[[Joint, Array, Array], Array] | None:
        return self._least_likely if self.replace else None

    def _least_likely(
        self, joint: Joint, needed: Int[Array, ""], measured: Bool[Array, "N"]
    ) -> Bool[Array, "N"]:
        provisional = joint.alive & ~joint.life.confirmed & ~measured
        odds = jnp.where(provisional, joint.life.log_odds, jnp.inf)
        rank = jnp.argsort(jnp.argsort(odds))  # of each slot, 0 for the least likely
        evicted: Array = provisional & (rank < needed)
        return evicted


def _log_odds(probability: Number, dtype: jnp.dtype) -> Array:
    p = jnp.asarray(probability, dtype)
    return jnp.log(p / (1 - p))
