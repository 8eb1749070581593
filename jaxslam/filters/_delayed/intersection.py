"""The third step: new measurements without a hypothesis are intersected with older ones."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.slots import Joint
from jaxslam.filters._delayed.delayed_settings import DelayedSettings
from jaxslam.filters._delayed.hypotheses import (
    UncertainPoints,
    closer_than,
    relative_spread,
    relative_to_robot,
)
from jaxslam.filters._delayed.state import (
    SIZE,
    DelayedState,
    NewMeasurements,
    TableLayout,
    covariance_rows,
    increased,
)
from jaxslam.filters._delayed.triangulation import Triangulation
from jaxslam.math._xla import materialize, where_any


def intersect_measurements(
    settings: DelayedSettings,
    state: DelayedState,
    new: NewMeasurements,
    slot: Int[Array, "M"],
    unexplained: Bool[Array, "M"],
) -> DelayedState:
    """The state with new hypotheses at the intersections of small covariance.

    Where identities are known each is intersected with the partner that gives the least spread,
    otherwise with all. No hypothesis is formed where one exists already.

    Args:
        slot: of the measurements in the table.
        unexplained: those stored that are within the gate of no hypothesis.
    """

    def form(state: DelayedState) -> DelayedState:
        sharpest = _sharpest(settings, state, new, slot, unexplained)
        return _form_hypotheses(settings, state, sharpest)

    return where_any(unexplained.any(), form, lambda s: s, state)


class _Sharpest(NamedTuple):
    """The k intersections of least relative spread, in ascending order."""

    points: UncertainPoints
    """(k,); the covariances relative to the sensor"""
    ok: Bool[Array, "k"]
    """allowed, and of spread small enough for a hypothesis"""
    pair: Int[Array, "k"]
    """a number of the two stored measurements, which mirrored points have in common"""
    parents: Int[Array, "k 2"]
    """their slots"""
    which: Int[Array, "k"]
    """which of their A points it is"""
    tag: Int[Array, "k"]
    group: Int[Array, "k"]
    """hypotheses of one group exclude each other"""


def _sharpest(
    settings: DelayedSettings,
    state: DelayedState,
    new: NewMeasurements,
    slot: Int[Array, "M"],
    unexplained: Bool[Array, "M"],
) -> _Sharpest:
    """The intersections of least spread of unexplained measurements, one a hypothesis slot."""
    layout, joint = settings.layout, state.joint
    found = _intersections_of(joint, layout, settings.triangulation, slot)
    older = joint.alive[layout.of_stored] & (state.taken_at < state.clock)
    allowed = unexplained[:, None] & older[None, :]
    allowed = allowed & (new.tag[:, None] == joint.tag[None, layout.of_stored])
    sharp = found.ok & allowed[:, :, None] & (found.spread <= settings.hypotheses.spread)
    spread = jnp.where(sharp, found.spread, jnp.inf)
    if settings.by_tag:  # only the best partner
        partner = jnp.argmin(spread.min(axis=2), axis=1)
        sharp = sharp & (partner[:, None] == jnp.arange(layout.stored)[None, :])[:, :, None]
        spread = jnp.where(sharp, spread, jnp.inf)
    m, w, a = spread.shape
    count = min(spread.size, layout.hypotheses)
    best = jax.lax.top_k(-jax.lax.stop_gradient(spread.reshape(-1)), count)[1]
    measurement, pair, which = best // (w * a), best // a, best % a
    tag = new.tag[measurement]
    return _Sharpest(
        points=UncertainPoints(
            found.points.reshape(-1, 2)[best], found.cov.reshape(-1, 2, 2)[best]
        ),
        ok=sharp.reshape(-1)[best],
        pair=pair,
        parents=jnp.stack([slot[measurement], layout.first_stored + pair % w], axis=1),
        which=which,
        tag=tag,
        group=tag if settings.by_tag else state.clock * (m * w) + pair,
    )


def _form_hypotheses(
    settings: DelayedSettings, state: DelayedState, found: _Sharpest
) -> DelayedState:
    """The state with hypotheses at new intersections, while slots are free."""
    layout, joint = settings.layout, state.joint
    wanted = found.ok & ~_duplicates(settings, joint, found)
    place, granted = slots.allocate(joint.alive[layout.of_hypotheses], wanted)
    source = granted[None, :] & (place[None, :] == jnp.arange(layout.hypotheses)[:, None])
    formed, source = source.any(axis=1), jnp.argmax(source, axis=1)
    parents, which, tag = found.parents[source], found.which[source], found.tag[source]
    joint = add_hypotheses(joint, layout, settings.triangulation, formed, parents, which, tag)
    refused = increased(state.counts.refused, wanted & ~granted)
    return state._replace(
        joint=joint,
        persistence=jnp.where(formed, 1.0, state.persistence),
        confirmed_at=jnp.where(formed, state.clock, state.confirmed_at),
        group=jnp.where(formed, found.group[source], state.group).astype(jnp.int32),
        parents=jnp.where(formed[:, None], parents, state.parents).astype(jnp.int32),
        counts=state.counts._replace(refused=refused),
    )


def _duplicates(settings: DelayedSettings, joint: Joint, found: _Sharpest) -> Bool[Array, "k"]:
    """Which intersections duplicate one of less spread, or an earlier hypothesis.

    Mirrored points of one pair are not duplicates of each other.
    """
    layout, count = settings.layout, len(found.pair)
    old = relative_to_robot(joint, layout)
    old = old._replace(mean=joint.pose[None, :2] + old.mean)
    others = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), found.points, old)
    limit = settings.hypotheses.same_below
    close = closer_than(settings.hypotheses.distance, limit, found.points, others)
    of_sharper, of_old = close[:, :count], close[:, count:]
    sharper = jnp.arange(count)[:, None] > jnp.arange(count)[None, :]
    of_sharper = of_sharper & sharper & found.ok[None, :]
    of_sharper = of_sharper & (found.pair[:, None] != found.pair[None, :])
    of_sharper = of_sharper & (found.tag[:, None] == found.tag[None, :])
    of_old = of_old & joint.alive[layout.of_hypotheses][None, :]
    of_old = of_old & (found.tag[:, None] == joint.tag[layout.of_hypotheses][None, :])
    return of_sharper.any(axis=1) | of_old.any(axis=1)


class _Intersections(NamedTuple):
    """The points where each of q stored measurements intersects each of all W."""

    points: Float[Array, "q W A 2"]
    ok: Bool[Array, "q W A"]
    """whether it is a point"""
    cov: Float[Array, "q W A 2 2"]
    """of the point relative to the position of the first of the two"""
    spread: Float[Array, "q W A"]
    """√(largest eigenvalue of that) over the distance, infinite where not ok"""


def _intersections_of(
    joint: Joint, layout: TableLayout, triangulation: Triangulation, stored: Int[Array, "q"]
) -> _Intersections:
    """The intersections of the measurements in these slots; J P Jᵀ with the P of each two.

    Relative to the sensor's position, so that the uncertainty of the robot's pose in the map
    does not affect the spread of an intersection.
    """
    intersect = triangulation.intersect
    first, count = layout.first_stored, layout.stored

    def one(
        a: Float[Array, "3"], b: Float[Array, "3"], cov: Float[Array, "6 6"]
    ) -> tuple[Array, Array, Array, Array]:
        points, ok = intersect(a, b)
        by_a, by_b = jax.jacfwd(lambda a, b: intersect(a, b)[0], argnums=(0, 1))(a, b)
        by_a = by_a - jnp.eye(2, SIZE, dtype=by_a.dtype)[None]
        jacobian = jnp.concatenate([by_a, by_b], axis=2)
        relative = jnp.einsum("aij,jk,alk->ail", jacobian, cov, jacobian)
        spread = relative_spread(UncertainPoints(points - a[None, :2], relative))
        return points, ok, relative, jnp.where(ok, spread, jnp.inf)

    start = 3 + SIZE * first
    blocks = joint.cov[start:, start:].reshape(count, SIZE, count, SIZE)
    mine, every = stored - first, jnp.arange(count)
    p_aa, p_ab = (
        blocks[mine, :, mine],
        blocks[mine].transpose(0, 2, 1, 3),
    )  # (q, 3, 3), (q, W, 3, 3)
    p_bb = blocks[every, :, every]
    shape = p_ab.shape
    top = jnp.concatenate([jnp.broadcast_to(p_aa[:, None], shape), p_ab], axis=3)
    p_ba, p_bb = p_ab.transpose(0, 1, 3, 2), jnp.broadcast_to(p_bb[None], shape)
    pairs = jnp.concatenate([top, jnp.concatenate([p_ba, p_bb], axis=3)], axis=2)
    of_pairs = jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, 0))
    a, b = joint.landmarks[stored], joint.landmarks[first:]
    return materialize(_Intersections(*of_pairs(a, b, pairs)))


def add_hypotheses(
    joint: Joint,
    layout: TableLayout,
    triangulation: Triangulation,
    formed: Bool[Array, "C"],
    parents: Int[Array, "C 2"],
    which: Int[Array, "C"],
    tag: Int[Array, "C"],
) -> Joint:
    """The joint with hypotheses in dead slots, each an intersection of two stored measurements.

    δx = J δs to first order, so P_xx = J P_ss Jᵀ and the covariance with all else is J P_s·: the
    noise of a measurement is not counted twice, even if it is in many intersections.

    Args:
        formed: the slots, all dead.
        parents: slots of the two stored measurements.
        which: which of their A points.
    """
    count, capacity = layout.hypotheses, layout.slots
    a, b = joint.landmarks[parents[:, 0]], joint.landmarks[parents[:, 1]]

    def point(a: Float[Array, "3"], b: Float[Array, "3"], which: Int[Array, ""]) -> Array:
        return triangulation.intersect(a, b)[0][which]

    points = jax.vmap(point)(a, b, which)
    by_a, by_b = jax.vmap(jax.jacfwd(point, argnums=(0, 1)))(a, b, which)
    by_a, by_b = (jnp.where(formed[:, None, None], by, 0.0) for by in (by_a, by_b))
    rows = covariance_rows(joint)
    jp = jnp.einsum("cij,cjd->cid", by_a, rows[parents[:, 0]])
    jp = jp + jnp.einsum("cij,cjd->cid", by_b, rows[parents[:, 1]])
    columns = jp[:, :, 3:].reshape(count, 2, capacity, SIZE)
    own_cov = jnp.einsum("cinj,nkj->cink", columns[:, :, parents[:, 0]], by_a)
    own_cov = own_cov + jnp.einsum("cinj,nkj->cink", columns[:, :, parents[:, 1]], by_b)
    own_cov = jnp.pad(own_cov, [(0, 0), (0, 1), (0, 0), (0, 1)]).reshape(SIZE * count, SIZE * count)
    half = jnp.pad(jp, [(0, 0), (0, 1), (0, 0)]).reshape(SIZE * count, -1)
    hypothesis_rows = layout.hypothesis_rows
    half = materialize(half.at[:, hypothesis_rows].add(0.5 * own_cov))
    # Padding's unit variance goes first, to an exact zero; the third parameter keeps it.
    unit = (formed[:, None] & (jnp.arange(SIZE) < 2)[None]).reshape(-1).astype(joint.cov.dtype)
    at = jnp.arange(hypothesis_rows.start, hypothesis_rows.stop)
    cov = joint.cov.at[at, at].add(-unit)
    here = layout.of_hypotheses
    placed = jnp.where(formed[:, None], jnp.pad(points, [(0, 0), (0, 1)]), 0.0)
    return joint._replace(
        landmarks=joint.landmarks.at[here].add(placed),
        cov=cov.at[hypothesis_rows].add(half).at[:, hypothesis_rows].add(half.T),
        alive=joint.alive.at[here].set(joint.alive[here] | formed),
        tag=joint.tag.at[here].set(jnp.where(formed, tag, joint.tag[here]).astype(jnp.int32)),
    )
