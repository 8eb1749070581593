"""The last step: a hypothesis becomes a landmark, estimated from all its stored measurements.

For the most persistent hypothesis that this scan confirmed, at most `per_scan` times:

1. `_candidate`: it is persistent enough, more so than its alternatives, and its spread is small;
2. `_promote`: its stored measurements, and up to eight of them, the oldest and the newest;
3. `_locate`: the maximum-likelihood position, and a decision: accept it, wait, or refuse it;
4. `add_landmark` where accepted; its stored measurements and excluded hypotheses are deleted.
"""

from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Int, PyTree

from jaxslam.filters._delayed.delayed_filter import DelayedFilter
from jaxslam.filters._delayed.hypotheses import (
    closer_than,
    noise_of,
    point_residuals,
    relative_spread,
    relative_to_robot,
)
from jaxslam.filters._delayed.initialization import InitialEstimate, add_landmark, initial_estimate
from jaxslam.filters._delayed.state import (
    DelayedState,
    NewMeasurements,
    add_to,
    delete_slots,
    is_newer,
    slots_where,
)
from jaxslam.math._xla import materialize, where_any
from jaxslam.math.stats import chi2_quantiles

_USED = 8
"""The largest number of stored measurements of a landmark: two locate it, and the covariance of the
rest is small enough for the unrolled factors of `linalg`."""

_UNLIKELY = 1e-3
"""The significance level of the chi-square test that refuses a landmark."""

_AMBIGUOUS = 9.0
"""The least difference of -2 log likelihood between a landmark's position and its mirror solution:
that of 3 σ."""

_ONE_PLACE = 0.02
"""Two estimates so close to each other, relative to the distance, are the same position."""


class Promoted(NamedTuple):
    """The outcome of the measurements of a scan that confirmed a hypothesis last."""

    slot: Int[Array, "M"]
    """slot of the landmark that was created; -1 if none"""
    refused: Bool[Array, "M"]
    """a hypothesis was ready, and the map is full"""

    @classmethod
    def none(cls, new: NewMeasurements) -> Self:
        """The outcome of a scan in which nothing was promoted."""
        return cls(jnp.full(len(new.tag), -1, jnp.int32), jnp.zeros_like(new.is_new))


def promote_hypotheses(
    filter: DelayedFilter,
    state: DelayedState,
    new: NewMeasurements,
    confirmed_by: Int[Array, "C"],
) -> tuple[DelayedState, Promoted]:
    """The state with the most persistent confirmed hypotheses promoted, waiting, or deleted.

    confirmed_by: the measurement that confirmed each hypothesis, or -1.
    """
    measurements = jnp.arange(len(new.tag))

    def promote_next(carry: PyTree, _: None) -> tuple[PyTree, None]:
        state, confirmed_by, promoted = carry
        ready, chosen = _candidate(filter, state, confirmed_by)
        free = ~state.joint.alive[filter.layout.of_landmarks]
        room, slot = free.any(), jnp.argmax(free)
        by = jnp.where(ready, confirmed_by[chosen], -1)
        before = state.counts.promoted
        tried = ready & room
        state = where_any(
            tried,
            lambda s: _promote(filter, s, chosen, slot, new.landmark_tag[by], tried),
            lambda s: s,
            state,
        )
        # A hypothesis is tried once a scan, and not after it was deleted.
        done = ready & (jnp.arange(len(confirmed_by)) == chosen)
        done = done | ~state.joint.alive[filter.layout.of_hypotheses]
        is_last = measurements == by
        succeeded = tried & (state.counts.promoted > before)
        promoted = Promoted(
            jnp.where(is_last & succeeded, slot, promoted.slot).astype(jnp.int32),
            promoted.refused | (is_last & ~room),
        )
        return (state, jnp.where(done, -1, confirmed_by), promoted), None

    start = state, confirmed_by, Promoted.none(new)
    (state, _, promoted), _ = jax.lax.scan(
        promote_next, start, None, length=filter.promotion.per_scan
    )
    return state, promoted._replace(refused=promoted.refused & (promoted.slot < 0))


def _candidate(
    filter: DelayedFilter, state: DelayedState, confirmed_by: Int[Array, "C"]
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """Whether a confirmed hypothesis may be promoted, and the most persistent such hypothesis."""
    layout, promotion, level = filter.layout, filter.promotion, state.persistence
    alive = state.joint.alive[layout.of_hypotheses]
    excluding = (state.group[:, None] == state.group[None, :]) & alive[None, :]
    excluding = excluding & ~jnp.eye(layout.hypotheses, dtype=bool)
    ahead = ~(excluding & (level[None, :] > level[:, None] - promotion.lead)).any(axis=1)
    sharp = relative_spread(relative_to_robot(state.joint, layout)) <= promotion.spread
    may = alive & (confirmed_by >= 0) & (level >= promotion.persistence) & ahead & sharp
    return may.any(), jnp.argmax(jnp.where(may, level, -jnp.inf))


def _promote(
    filter: DelayedFilter,
    state: DelayedState,
    chosen: Int[Array, ""],
    slot: Int[Array, ""],
    tag: Int[Array, ""],
    tried: Bool[Array, ""],
) -> DelayedState:
    """The state after the decision on a hypothesis; exactly as before where it is not tried.

    slot, tag: of the landmark that it may become.
    """
    layout, joint = filter.layout, state.joint
    hypothesis = layout.landmarks + chosen
    same_tag = joint.alive[layout.of_stored]
    same_tag = same_tag & (joint.tag[layout.of_stored] == joint.tag[hypothesis])
    residuals = point_residuals(joint, filter.triangulation, hypothesis[None], layout.stored_slots)
    # After the correction by its measurements g has almost no variance: that of the noise is
    # added, for rounding and curvature.
    noise = noise_of(filter, state, layout.stored_slots)
    variance = residuals.variance[0] + noise.variance(residuals.value[0])
    stored = same_tag & (residuals.value[0] ** 2 <= filter.gamma * variance)
    # Of these the oldest and the newest, which were taken from the positions farthest apart: ranks
    # from the oldest, 1 … n; the larger one of the ranks from both ends is outermost.
    rank = (stored[None, :] & ~is_newer(state.taken_at)).sum(axis=1)
    outer = jnp.where(stored, jnp.maximum(rank, stored.sum() + 1 - rank), 0)
    best = jax.lax.top_k(outer, min(_USED, layout.stored))[1]
    used, use = layout.stored_slots[best], stored[best]
    estimate, accepted, undecided = _locate(filter, state, chosen, used, use)
    # In a batch, the runs without a promotion stay exactly as they are.
    accepted, undecided = materialize((accepted & tried, undecided | ~tried))

    with_landmark = add_landmark(joint, estimate, slot, used)
    joint = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), with_landmark, joint)
    is_slot = accepted & (jnp.arange(layout.slots) == slot)
    joint = joint._replace(tag=jnp.where(is_slot, tag, joint.tag).astype(jnp.int32))
    state = state._replace(joint=joint)

    used_up = accepted & (same_tag if filter.by_tag else stored)
    itself = jnp.arange(layout.hypotheses) == chosen
    rivals = _rivals(filter, state, chosen, slots_where(layout, stored=used_up))
    rivals = rivals & joint.alive[layout.of_hypotheses] & ~itself & accepted
    counts = state.counts._replace(
        rivals=add_to(state.counts.rivals, rivals),
        promoted=add_to(state.counts.promoted, accepted),
        refuted=add_to(state.counts.refuted, ~accepted & ~undecided),
    )
    dead = slots_where(layout, hypotheses=(rivals | itself) & ~undecided, stored=used_up)
    return delete_slots(layout, state._replace(counts=counts), dead)


def _locate(
    filter: DelayedFilter,
    state: DelayedState,
    chosen: Int[Array, ""],
    used: Int[Array, "m"],
    use: Bool[Array, "m"],
) -> tuple[InitialEstimate, Bool[Array, ""], Bool[Array, ""]]:
    """The maximum-likelihood position from m stored measurements, and the decision on it.

    Estimated from the hypothesis, and from its mirror solutions in two measurements that were taken
    far from each other.

    Returns:
        The estimate; whether it is accepted as a landmark; and whether that is undecided, since its
        covariance is still too large, or another position fits nearly as well. If it is neither,
        its measurements contradict each other.
    """
    joint, triangulation = state.joint, filter.triangulation
    start = joint.landmarks[filter.layout.landmarks + chosen, :2]
    s = joint.landmarks[used]
    reach = ((s[:, :2] - s[:1, :2]) ** 2).sum(axis=1)
    farthest = s[jnp.argmax(jnp.where(use, reach, -1.0))]
    mirrored = triangulation.mirror_solutions(s[0], farthest, start)
    noise = noise_of(filter, state, used)
    estimates = jax.vmap(initial_estimate, (None, None, None, 0, None, None))(
        joint, triangulation, noise, jnp.concatenate([start[None], mirrored]), used, use
    )
    cost = jnp.where(estimates.regular, estimates.nis, jnp.inf)
    first = jnp.argmin(cost)
    best = jax.tree.map(lambda leaf: leaf[first], estimates)

    far = ((estimates.point - best.point[None]) ** 2).sum(axis=1)
    scale = (_ONE_PLACE**2) * ((best.point - s[0, :2]) ** 2).sum()
    ambiguous = ((cost < best.nis + _AMBIGUOUS) & (far > scale)).any()
    undecided = best.regular & (ambiguous | (best.spread > filter.promotion.spread))
    # By degrees of freedom, from 1 on; constants, because the tail function is slow to compile.
    limits = jnp.asarray(chi2_quantiles(1 - _UNLIKELY, np.arange(1, _USED)), best.nis.dtype)
    dof = jnp.maximum(use.sum() - 2, 1)
    likely = best.nis <= limits[dof - 1]
    return best, best.regular & likely & ~undecided, undecided


def _rivals(
    filter: DelayedFilter,
    state: DelayedState,
    chosen: Int[Array, ""],
    used_up: Bool[Array, "S"],
) -> Bool[Array, "C"]:
    """Mask of the hypotheses excluded by a landmark made of the chosen one, itself included.

    used_up: mask of the slots of the stored measurements that the landmark is made of.
    """
    rivals = state.group == state.group[chosen]
    if filter.by_tag:
        return rivals
    # A measurement is of one landmark, so other hypotheses made of these measurements are wrong,
    # and so is a second hypothesis at the same position.
    parents = state.parents
    rivals = rivals | ((parents >= 0) & used_up[jnp.maximum(parents, 0)]).any(axis=1)
    points = relative_to_robot(state.joint, filter.layout)
    itself = jax.tree.map(lambda leaf: leaf[chosen][None], points)
    limit = filter.hypotheses.same_below
    same_place = closer_than(filter.hypotheses.distance, limit, points, itself)
    return rivals | same_place[:, 0]
