"""Removal of landmarks by their log-odds of existence."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam import slots
from jaxslam.core.numbers import check_count
from jaxslam.protocols import Life
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Status

_LARGEST = 10.0
"""bound of the log-odds, so that a landmark that was measured often is removed after some misses"""


class Existence(NamedTuple):
    """The existence state of each slot's landmark; zero where dead."""

    log_odds: Float[Array, "N"]
    """log-odds that it exists"""
    confirmed: Bool[Array, "N"]
    """its probability has reached `confirm`; before that it is provisional"""
    seen: Int[Array, "N"]
    """scans that measured it"""
    missed: Int[Array, "N"]
    """scans that should have measured it, and did not"""
    since: Int[Array, "N"]
    """scans since it was last measured"""


def existence(
    visible: Callable[[Array, Array], Array],
    *,
    detected: float = 0.9,
    false: float = 0.1,
    confirm: float = 0.95,
    remove: float = 0.05,
    patience: int | None = None,
    spread: float | None = None,
    replace: bool = False,
) -> Life:
    """The rule that keeps and removes landmarks by their log-odds of existence.

    These are updated as those of an occupancy map's cell (Thrun, Burgard, Fox, "Probabilistic
    Robotics", 2005, sections 9.2 and 13.9, where landmarks are removed by negative evidence).

    A landmark begins at even odds. Each scan that measures it adds log(detected/false), each that
    should have and does not adds log((1 - detected)/(1 - false)). Where the probability comes to
    `confirm` it is confirmed permanently, where it falls to `remove` it is removed from the map.
    Provisional landmarks are corrected as all others are.

    Args:
        visible: (pose, l) -> () bool: whether a scan from there should measure the landmark.
            Prefer a strict one: a sensor misses many landmarks near the edge of its view.
        detected: probability that it then does, P(seen | there).
        false: probability of a false detection, P(seen | not there).
        confirm, remove: probabilities.
        patience: a provisional landmark not measured for so many scans is removed.
        spread: [m] a landmark with a larger standard deviation, √(tr P/2), is removed.
        replace: in a full map, new landmarks take the place of those least likely to exist among
            the provisional ones that the scan did not measure; otherwise the map refuses
            (`Status.OVERFLOW`). The filter needs it too: `ekf_slam(…, make_room=life)`.
    Raises:
        ValueError: on a visible that is no function; unless 0 < false < detected < 1 and
            0 < remove < 1/2 < confirm < 1; on a patience below 1 or a spread not above 0.
    """
    if not callable(visible):
        raise ValueError(f"existence: expected visible to be a function, got {visible!r}")
    if not 0 < false < detected < 1:
        raise ValueError(f"existence: expected 0 < false < detected < 1, got {false}, {detected}")
    if not 0 < remove < 0.5 < confirm < 1:
        raise ValueError(
            f"existence: expected 0 < remove < 1/2 < confirm < 1, got {remove}, {confirm}"
        )
    if patience is not None:
        check_count("existence: patience", patience)
    if spread is not None and not spread > 0:
        raise ValueError(f"existence: expected a spread above 0, got {spread}")
    gain, loss = math.log(detected / false), math.log((1 - detected) / (1 - false))
    high, low = math.log(confirm / (1 - confirm)), math.log(remove / (1 - remove))

    def init(pose: Float[Array, "3"], landmarks: Float[Array, "N L"]) -> Existence:
        capacity = landmarks.shape[0]
        none = jnp.zeros(capacity, jnp.int32)
        return Existence(
            jnp.zeros(capacity, pose.dtype), jnp.zeros(capacity, bool), none, none, none
        )

    def after(
        joint: Joint, info: Info, estimate: Callable[[], Estimate]
    ) -> tuple[Existence, Bool[Array, "N"]]:
        count = len(joint.alive)
        born = slots.concerned(info.slot, info.status == Status.BORN, count)
        hit = born | slots.concerned(info.slot, info.status == Status.FUSED, count)
        known: Existence = joint.life
        old = jax.tree.map(lambda x: jnp.where(born | ~joint.alive, jnp.zeros_like(x), x), known)
        expected = joint.alive & ~hit & jax.vmap(visible, (None, 0))(joint.pose, joint.landmarks)
        change = jnp.where(hit & ~born, gain, 0.0) + jnp.where(expected, loss, 0.0)
        odds = jnp.clip(old.log_odds + change.astype(old.log_odds.dtype), -_LARGEST, _LARGEST)
        confirmed = joint.alive & (old.confirmed | (odds >= high))
        since = jnp.where(hit | ~joint.alive, 0, old.since + 1)
        dead = odds <= low
        if patience is not None:
            dead = dead | (~confirmed & (since >= patience))
        if spread is not None:
            variance = jnp.trace(estimate().point_covs, axis1=1, axis2=2) / 2
            dead = dead | (variance > spread**2)
        memory = Existence(
            odds, confirmed, old.seen + hit, old.missed + expected, since.astype(jnp.int32)
        )
        return memory, dead & joint.alive

    def make_room(
        joint: Joint, needed: Int[Array, ""], measured: Bool[Array, "N"]
    ) -> Bool[Array, "N"]:
        provisional = joint.alive & ~joint.life.confirmed & ~measured
        odds = jnp.where(provisional, joint.life.log_odds, jnp.inf)
        rank = jnp.argsort(jnp.argsort(odds))
        evicted: Array = provisional & (rank < needed)
        return evicted

    return Life("existence", init, after, make_room if replace else None)
