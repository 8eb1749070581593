"""What the sightings of a scan do: they enter the table, confirm hypotheses, and form new ones."""

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.filters.delayed import hypotheses as table
from jaxslam.filters.delayed.state import Delayed, Fresh, Rules, after, more, without
from jaxslam.math.xla import where_any

Array = jax.Array


def take(rules: Rules, state: Delayed, scan: Fresh) -> tuple[Delayed, Array, Array]:
    """Measurements of a scan as sightings: their slots (M,), and which were granted (M,)."""
    layout = rules.layout
    joint = state.joint
    sight = jax.vmap(rules.meeting.sight, (None, 0))
    seen = sight(joint.pose, scan.z)
    by_pose, by_z = jax.vmap(jax.jacfwd(rules.meeting.sight, argnums=(0, 1)), (None, 0))(
        joint.pose, scan.z
    )
    apart = seen[:, None, :2] - joint.landmarks[None, layout.of_sightings, :2]
    close = ((apart**2).sum(axis=2) < rules.spacing**2) & joint.alive[None, layout.of_sightings]
    close = close & (scan.tag[:, None] == joint.tag[None, layout.of_sightings])
    wanted = scan.fresh & ~close.any(axis=1)
    alive = joint.alive[layout.of_sightings]
    needed = wanted.sum() - (~alive).sum()
    age = jnp.where(alive, state.taken, state.clock + 1)
    evicted = alive & (after(age).sum(axis=0) < needed)
    gone = jnp.zeros(layout.slots, bool).at[layout.of_sightings].set(evicted)
    state = where_any(evicted.any(), lambda s: without(layout, s, gone), lambda s: s, state)
    joint = state.joint
    slot, granted = slots.allocate(joint.alive[layout.of_sightings], wanted)
    own = jax.vmap(rules.sensor.noise_cov)(scan.z)
    own = jnp.einsum("mij,mjk,mlk->mil", by_z, own, by_z)
    joint = slots.scatter(
        joint, layout.first_sighting + slot, granted, seen, by_pose, own, scan.tag
    )
    at = jnp.where(granted, slot, layout.sightings)
    counts = state.counts._replace(evicted=more(state.counts.evicted, evicted))
    state = state._replace(
        joint=joint,
        taken=state.taken.at[at].set(state.clock, mode="drop"),
        noise=state.noise.at[at].set(own[:, 2, 2], mode="drop"),
        counts=counts,
    )
    return state, layout.first_sighting + slot, granted


def confirm(
    rules: Rules, state: Delayed, scan: Fresh, slot: Array, granted: Array
) -> tuple[Delayed, Array, Array]:
    """Hypotheses confirmed, moved or let go; whether a sighting is explained (M,), and which
    measurement confirmed each hypothesis (C,), -1 where none."""
    layout = rules.layout
    joint = state.joint
    alive = joint.alive[layout.of_hypotheses]
    concerned = alive[:, None] & granted[None, :]
    concerned = concerned & (joint.tag[layout.of_hypotheses][:, None] == scan.tag[None, :])
    miss = table.misses(joint, rules.meeting, layout.hypothesis_slots, slot)
    squared = jnp.where(concerned, miss.squared(), jnp.inf)
    best = jnp.argmin(squared, axis=1)
    every = jnp.arange(layout.hypotheses)
    hit = squared[every, best] <= rules.gate
    found = table.constraints(
        joint,
        layout.hypothesis_slots,
        slot[best],
        miss.value[every, best],
        miss.by_point[every, best],
        miss.by_sight[every, best],
    )
    joint = table.move_hypotheses(joint, layout, found, hit)
    loses = concerned.any(axis=1) & ~hit
    level = state.persistence + jnp.where(hit, 1.0, 0.0) - jnp.where(loses, rules.decay, 0.0)
    last = jnp.where(hit, state.clock, state.confirmed)
    stale = (state.clock - last > rules.patience) & scan.fresh.any()
    vanished = alive & ((level <= 0) | stale)
    counts = state.counts._replace(vanished=more(state.counts.vanished, vanished))
    state = state._replace(joint=joint, persistence=level, confirmed=last, counts=counts)
    gone = jnp.zeros(layout.slots, bool).at[layout.of_hypotheses].set(vanished)
    state = where_any(vanished.any(), lambda s: without(layout, s, gone), lambda s: s, state)
    explained = (squared <= rules.gate).any(axis=0)
    return state, explained, jnp.where(hit & ~vanished, best, -1)


def intersect(rules: Rules, state: Delayed, scan: Fresh, slot: Array, lonely: Array) -> Delayed:
    """New hypotheses where the sightings lonely (M,) meet older ones."""
    layout = rules.layout
    joint = state.joint
    found = table.meetings(joint, layout, rules.meeting, slot)
    older = joint.alive[layout.of_sightings] & (state.taken < state.clock)
    allowed = lonely[:, None] & older[None, :]
    allowed = allowed & (scan.tag[:, None] == joint.tag[None, layout.of_sightings])
    fine = found.ok & allowed[:, :, None] & (found.spread <= rules.spread)
    cost = jnp.where(fine, found.spread, jnp.inf)
    if rules.tagged:  # the best conditioned partner alone
        partner = jnp.argmin(cost.min(axis=2), axis=1)
        fine = fine & (partner[:, None] == jnp.arange(layout.sightings)[None, :])[:, :, None]
        cost = jnp.where(fine, cost, jnp.inf)
    _, w, a = cost.shape
    tried = min(cost.size, layout.hypotheses)
    best = jax.lax.top_k(-jax.lax.stop_gradient(cost.reshape(-1)), tried)[1]
    good = fine.reshape(-1)[best]
    points, covs = found.points.reshape(-1, 2)[best], found.cov.reshape(-1, 2, 2)[best]
    place, pair, which = best // (w * a), best // a, best % a
    tag = scan.tag[place]
    # At most once at a place: not where an equal or better one is, nor a hypothesis of before.
    old, old_covs = table.from_robot(joint, layout)
    others = jnp.concatenate([points, joint.pose[None, :2] + old])
    close = table.near(
        rules.distance, rules.same, points, covs, others, jnp.concatenate([covs, old_covs])
    )
    again, there = close[:, :tried], close[:, tried:]
    earlier = jnp.arange(tried)[:, None] > jnp.arange(tried)[None, :]
    again = again & earlier & good[None, :] & (pair[:, None] != pair[None, :])
    again = again & (tag[:, None] == tag[None, :])
    there = there & joint.alive[layout.of_hypotheses][None, :]
    there = there & (tag[:, None] == joint.tag[layout.of_hypotheses][None, :])
    wanted = good & ~again.any(axis=1) & ~there.any(axis=1)
    home, granted = slots.allocate(joint.alive[layout.of_hypotheses], wanted)
    source = granted[None, :] & (home[None, :] == jnp.arange(layout.hypotheses)[:, None])
    born, source = source.any(axis=1), jnp.argmax(source, axis=1)
    parents = jnp.stack([slot[place], layout.first_sighting + pair % w], axis=1)[source]
    group = tag[source] if rules.tagged else state.clock * (len(scan.tag) * w) + pair[source]
    joint = table.form(joint, layout, rules.meeting, born, parents, which[source], tag[source])
    counts = state.counts
    counts = counts._replace(refused=more(counts.refused, (wanted & ~granted)))
    return state._replace(
        joint=joint,
        persistence=jnp.where(born, 1.0, state.persistence),
        confirmed=jnp.where(born, state.clock, state.confirmed),
        group=jnp.where(born, group, state.group).astype(jnp.int32),
        parents=jnp.where(born[:, None], parents, state.parents).astype(jnp.int32),
        counts=counts,
    )
