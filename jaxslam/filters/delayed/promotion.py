"""The step from hypothesis to landmark, with all its sightings at once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filters.delayed import hypotheses as table
from jaxslam.filters.delayed.initialization import InitialEstimate, add_landmark, initial_estimate
from jaxslam.filters.delayed.state import Delayed, Rules, after, more, without
from jaxslam.math.stats import chi2_quantiles
from jaxslam.math.xla import settle, where_any

Array = jax.Array

# Sightings that a landmark is made of at its promotion: two locate it, and the others are a
# matrix that `linalg` factors without a library call.
_USED = 8

# A landmark whose sightings fit together so badly, or worse, by chance this seldom is none.
_UNLIKELY = 1e-3

# By so much -2 log likelihood must the place of a landmark be better than its twin.
_CLOSE = 9.0

# Two descents that end so close, relative to the distance, ended at one place. Beyond, two places
# explain the sightings, however near each other.
_ONE_PLACE = 0.02


def promote(
    rules: Rules, state: Delayed, names: Array, by: Array
) -> tuple[Delayed, Array, Array, Array]:
    """The hypothesis that is most persistent, if it may, as a landmark.

    by (C,): the measurement that confirmed each. Returns by without it, and the measurement
    and the slot: measurement -1 where none may, slot -1 where the map is full, -2 where its
    sightings do not fit together, or not yet in one place.
    """
    layout = rules.layout
    joint = state.joint
    alive = joint.alive[layout.of_hypotheses]
    others = (state.group[:, None] == state.group[None, :]) & alive[None, :]
    others = others & ~jnp.eye(layout.hypotheses, dtype=bool)
    level = state.persistence
    ahead = ~(others & (level[None, :] > level[:, None] - rules.lead)).any(axis=1)
    sharp = table.relative_spread(*table.from_robot(joint, layout)) <= rules.ready
    may = alive & (by >= 0) & (level >= rules.persistence) & ahead & sharp
    chosen = jnp.argmax(jnp.where(may, level, -jnp.inf))
    free = ~joint.alive[layout.of_landmarks]
    any_may, room = may.any(), free.any()
    go = any_may & room
    home = jnp.argmax(free)
    place = jnp.where(any_may, by[chosen], -1)

    def entering(state: Delayed) -> Delayed:
        joint = state.joint
        origin = layout.landmarks + chosen
        # Its sightings: of its tag, or those that see it.
        seen = joint.alive[layout.of_sightings]
        seen = seen & (joint.tag[layout.of_sightings] == joint.tag[origin])
        miss = table.misses(joint, rules.meeting, origin[None], layout.sighting_slots)
        # Of its own sightings the variance is almost none: rounding and curvature remain.
        variance = miss.variance[0] + state.noise
        seeing = seen & (miss.value[0] ** 2 <= rules.gate * variance)
        fit, sights, verdict = _explanation(rules, state, origin, seeing)
        # Of a batch, the runs without a promotion wait, and keep all they have to the bit.
        verdict = settle(_Verdict(verdict.yes & go, verdict.wait | ~go))
        entered = add_landmark(joint, fit, home, sights)
        joint = jax.tree.map(lambda a, b: jnp.where(verdict.yes, a, b), entered, joint)
        mine = verdict.yes & (jnp.arange(layout.slots) == home)
        joint = joint._replace(tag=jnp.where(mine, names[place], joint.tag).astype(jnp.int32))
        leaving = verdict.yes & (seen if rules.tagged else seeing)
        gone = jnp.zeros(layout.slots, bool).at[layout.of_sightings].set(leaving)
        itself = jnp.arange(layout.hypotheses) == chosen
        rivals = _rivals(rules, state._replace(joint=joint), chosen, gone)
        rivals = rivals & joint.alive[layout.of_hypotheses] & ~itself & verdict.yes
        gone = gone.at[layout.of_hypotheses].set((rivals | itself) & ~verdict.wait)
        counts = state.counts
        counts = counts._replace(
            rivals=more(counts.rivals, rivals),
            promoted=more(counts.promoted, verdict.yes),
            refuted=more(counts.refuted, ~verdict.yes & ~verdict.wait),
        )
        return without(layout, state._replace(joint=joint, counts=counts), gone)

    before = state.counts.promoted
    state = where_any(go, entering, lambda s: s, state)
    dealt_with = any_may & (jnp.arange(layout.hypotheses) == chosen)
    by = jnp.where(dealt_with | ~state.joint.alive[layout.of_hypotheses], -1, by)
    done = go & (state.counts.promoted > before)
    return state, by, place, jnp.where(done, home, jnp.where(room, -2, -1))


class _Verdict(NamedTuple):
    """() bool each; where neither holds, the sightings contradict each other."""

    yes: Array
    """the hypothesis becomes a landmark"""
    wait: Array
    """its place is not sharp yet, or another explains the sightings nearly as well"""


def _explanation(
    rules: Rules, state: Delayed, origin: Array, seeing: Array
) -> tuple[InitialEstimate, Array, _Verdict]:
    """The place that explains the sightings seeing (W,) of the hypothesis in slot origin best, and
    the slots of those it is made of."""
    joint = state.joint
    # The oldest and the newest, from the farthest places.
    rank = (seeing[None, :] & ~after(state.taken)).sum(axis=1)
    outer = jnp.where(seeing, jnp.maximum(rank, seeing.sum() + 1 - rank), 0)
    best = jax.lax.top_k(outer, min(_USED, rules.layout.sightings))[1]
    use, sights = seeing[best], rules.layout.sighting_slots[best]
    start = joint.landmarks[origin, :2]
    # With the twin of two sightings that are far from each other.
    places = joint.landmarks[sights]
    reach = ((places[:, :2] - places[:1, :2]) ** 2).sum(axis=1)
    other = places[jnp.argmax(jnp.where(use, reach, -1.0))]
    starts = jnp.concatenate([start[None], rules.meeting.twins(places[0], other, start)])
    fits = jax.vmap(initial_estimate, (None, None, 0, None, None))(
        joint, rules.meeting, starts, sights, use
    )
    cost = jnp.where(fits.regular, fits.nis, jnp.inf)
    first = jnp.argmin(cost)
    fit = jax.tree.map(lambda part: part[first], fits)
    # Another place that explains the sightings nearly as well: wait for more.
    far = ((fits.point - fit.point[None]) ** 2).sum(axis=1)
    scale = (_ONE_PLACE**2) * ((fit.point - places[0, :2]) ** 2).sum()
    ambiguous = ((cost < fit.nis + _CLOSE) & (far > scale)).any()
    wait = fit.regular & (ambiguous | (fit.spread > rules.ready))
    # By degrees of freedom, from 1 on; of numbers, since the tail itself is much code to compile.
    limits = jnp.asarray(chi2_quantiles(1 - _UNLIKELY, np.arange(1, _USED)), fit.nis.dtype)
    dof = jnp.maximum(use.sum() - 2, 1)
    likely = fit.nis <= limits[dof - 1]
    return fit, sights, _Verdict(fit.regular & likely & ~wait, wait)


def _rivals(rules: Rules, state: Delayed, chosen: Array, gone: Array) -> Array:
    """(C,) bool: the hypotheses that a landmark made of one rules out, itself among them.

    gone (S,): the slots that its sightings leave.
    """
    rivals = state.group == state.group[chosen]
    if rules.tagged:
        return rivals
    # A measurement is of one landmark, so what else was made of these is none; nor is a second
    # hypothesis of the same place.
    parents = state.parents
    rivals = rivals | ((parents >= 0) & gone[jnp.maximum(parents, 0)]).any(axis=1)
    points, covs = table.from_robot(state.joint, rules.layout)
    same_place = table.near(
        rules.distance, rules.same, points, covs, points[chosen][None], covs[chosen][None]
    )
    return rivals | same_place[:, 0]
