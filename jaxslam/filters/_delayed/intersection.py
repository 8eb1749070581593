"""The third step: new measurements without a hypothesis are intersected with older ones."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.slots import Joint
from jaxslam.filters._delayed.delayed_filter import DelayedFilter
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
    add_to,
    covariance_rows,
)
from jaxslam.filters._delayed.triangulation import Triangulation
from jaxslam.math._xla import materialize, where_any


def intersect_measurements(
    filter: DelayedFilter,
    state: DelayedState,
    new: NewMeasurements,
    slot: Int[Array, "M"],
    unexplained: Bool[Array, "M"],
) -> DelayedState:
    """The state with new hypotheses at the intersections of small covariance.

    A measurement is intersected with the partner that gives the least spread if identities are
    known, otherwise with all. No hypothesis is formed where one exists already.

    Args:
        slot: slots of the measurements in the table.
        unexplained: mask of the stored measurements within the gate of no hypothesis.
    """

    def form(state: DelayedState) -> DelayedState:
        candidates = _sharpest_intersections(filter, state, new, slot, unexplained)
        return _form_hypotheses(filter, state, candidates)

    return where_any(unexplained.any(), form, lambda s: s, state)


class _Candidates(NamedTuple):
    """The k intersections of least relative spread, in ascending order."""

    points: UncertainPoints
    """(k,); the covariances relative to the sensor"""
    ok: Bool[Array, "k"]
    """allowed, and of spread small enough for a hypothesis"""
    pair: Int[Array, "k"]
    """number of the pair of stored measurements, the same for mirrored points"""
    parents: Int[Array, "k 2"]
    """slots of the pair"""
    which: Int[Array, "k"]
    """index of the point among the A intersections of the pair"""
    tag: Int[Array, "k"]
    group: Int[Array, "k"]
    """hypotheses of one group exclude each other"""


def _sharpest_intersections(
    filter: DelayedFilter,
    state: DelayedState,
    new: NewMeasurements,
    slot: Int[Array, "M"],
    unexplained: Bool[Array, "M"],
) -> _Candidates:
    """The C intersections of least spread of unexplained measurements."""
    layout, joint = filter.layout, state.joint
    points, ok, cov, spread = _intersections_of(joint, layout, filter.triangulation, slot)
    older = joint.alive[layout.of_stored] & (state.taken_at < state.clock)
    allowed = unexplained[:, None] & older[None, :]
    allowed = allowed & (new.tag[:, None] == joint.tag[None, layout.of_stored])
    sharp = ok & allowed[:, :, None] & (spread <= filter.hypotheses.spread)
    spread = jnp.where(sharp, spread, jnp.inf)
    if filter.by_tag:  # only the best partner
        partner = jnp.argmin(spread.min(axis=2), axis=1)
        sharp = sharp & (partner[:, None] == jnp.arange(layout.stored)[None, :])[:, :, None]
        spread = jnp.where(sharp, spread, jnp.inf)
    m, w, _ = spread.shape
    # top_k finds the largest, hence the negative; a choice has no derivative.
    count = min(spread.size, layout.hypotheses)
    best = jax.lax.top_k(-jax.lax.stop_gradient(spread.reshape(-1)), count)[1]
    measurement, partner, which = jnp.unravel_index(best, spread.shape)
    pair = measurement * w + partner
    tag = new.tag[measurement]
    return _Candidates(
        points=UncertainPoints(points.reshape(-1, 2)[best], cov.reshape(-1, 2, 2)[best]),
        ok=sharp.reshape(-1)[best],
        pair=pair,
        parents=jnp.stack([slot[measurement], layout.first_stored + partner], axis=1),
        which=which,
        tag=tag,
        # A number per scan and pair. In int32 it wraps after 2³¹/(m·w) scans, which is harmless:
        # groups are only compared for equality, and equal ones are 2³²/(m·w) scans apart.
        group=tag if filter.by_tag else state.clock * (m * w) + pair,
    )


def _form_hypotheses(
    filter: DelayedFilter, state: DelayedState, candidates: _Candidates
) -> DelayedState:
    """The state with hypotheses at new intersections, while slots are free."""
    layout, joint = filter.layout, state.joint
    wanted = candidates.ok & ~_duplicates(filter, joint, candidates)
    place, granted = slots.allocate(joint.alive[layout.of_hypotheses], wanted)
    # By slots: whether a hypothesis is formed there, and its candidate.
    source = granted[None, :] & (place[None, :] == jnp.arange(layout.hypotheses)[:, None])
    formed, source = source.any(axis=1), jnp.argmax(source, axis=1)
    parents, which = candidates.parents[source], candidates.which[source]
    joint = add_hypotheses(
        joint, layout, filter.triangulation, formed, parents, which, candidates.tag[source]
    )
    return state._replace(
        joint=joint,
        persistence=jnp.where(formed, 1.0, state.persistence),
        confirmed_at=jnp.where(formed, state.clock, state.confirmed_at),
        group=jnp.where(formed, candidates.group[source], state.group).astype(jnp.int32),
        parents=jnp.where(formed[:, None], parents, state.parents).astype(jnp.int32),
        counts=state.counts._replace(refused=add_to(state.counts.refused, wanted & ~granted)),
    )


def _duplicates(filter: DelayedFilter, joint: Joint, candidates: _Candidates) -> Bool[Array, "k"]:
    """Mask of the intersections that duplicate one of less spread, or an earlier hypothesis.

    Mirrored points of one pair are not duplicates of each other.
    """
    layout, count = filter.layout, len(candidates.pair)
    old = relative_to_robot(joint, layout)
    old = old._replace(mean=joint.pose[None, :2] + old.mean)
    others = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), candidates.points, old)
    limit = filter.hypotheses.same_below
    close = closer_than(filter.hypotheses.distance, limit, candidates.points, others)
    of_sharper, of_old = close[:, :count], close[:, count:]
    # In ascending order of spread, a sharper one has a smaller index.
    sharper = jnp.arange(count)[:, None] > jnp.arange(count)[None, :]
    of_sharper = of_sharper & sharper & candidates.ok[None, :]
    of_sharper = of_sharper & (candidates.pair[:, None] != candidates.pair[None, :])
    of_sharper = of_sharper & (candidates.tag[:, None] == candidates.tag[None, :])
    of_old = of_old & joint.alive[layout.of_hypotheses][None, :]
    of_old = of_old & (candidates.tag[:, None] == joint.tag[layout.of_hypotheses][None, :])
    return of_sharper.any(axis=1) | of_old.any(axis=1)


def _intersections_of(
    joint: Joint, layout: TableLayout, triangulation: Triangulation, stored: Int[Array, "q"]
) -> tuple[
    Float[Array, "q W A 2"], Bool[Array, "q W A"], Float[Array, "q W A 2 2"], Float[Array, "q W A"]
]:
    """The points where each of q stored measurements intersects each of all W.

    Returns:
        The points, and whether each is one; the covariances J P Jᵀ, P of the two measurements, of
        the points relative to the sensor's position at the first of the two, so that the
        uncertainty of the robot's pose in the map has no effect; and their relative spreads,
        infinite where there is no point.
    """
    intersect = triangulation.intersect
    first, count = layout.first_stored, layout.stored

    def intersect_pair(
        a: Float[Array, "3"], b: Float[Array, "3"], cov: Float[Array, "6 6"]
    ) -> tuple[Array, Array, Array, Array]:
        points, ok = intersect(a, b)
        by_a, by_b = jax.jacfwd(lambda a, b: intersect(a, b)[0], argnums=(0, 1))(a, b)
        by_a = by_a - jnp.eye(2, SIZE, dtype=by_a.dtype)[None]
        jacobian = jnp.concatenate([by_a, by_b], axis=2)
        relative = jnp.einsum("aij,jk,alk->ail", jacobian, cov, jacobian)
        spread = relative_spread(UncertainPoints(points - a[None, :2], relative))
        return points, ok, relative, jnp.where(ok, spread, jnp.inf)

    # The covariance (6, 6) of each pair, from the blocks (W, 3, W, 3) of the stored measurements.
    start = 3 + SIZE * first
    blocks = joint.cov[start:, start:].reshape(count, SIZE, count, SIZE)
    q, w = stored - first, jnp.arange(count)
    p_aa = blocks[q, :, q]  # (q, 3, 3)
    p_ab = blocks[q].transpose(0, 2, 1, 3)  # (q, W, 3, 3)
    p_bb = blocks[w, :, w]  # (W, 3, 3)
    shape = p_ab.shape
    top = jnp.concatenate([jnp.broadcast_to(p_aa[:, None], shape), p_ab], axis=3)
    p_ba, p_bb = p_ab.transpose(0, 1, 3, 2), jnp.broadcast_to(p_bb[None], shape)
    cov = jnp.concatenate([top, jnp.concatenate([p_ba, p_bb], axis=3)], axis=2)
    of_pairs = jax.vmap(jax.vmap(intersect_pair, (None, 0, 0)), (0, None, 0))
    intersections: tuple[Array, Array, Array, Array] = of_pairs(
        joint.landmarks[stored], joint.landmarks[first:], cov
    )
    return materialize(intersections)


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

    δx = J δs to first order, so P_xx = J P_ss Jᵀ and the covariance with the rest is J P_s·: the
    noise of a measurement is not counted twice, even if it is in many intersections.

    Args:
        formed: mask of the slots, all dead.
        parents: slots of the two stored measurements.
        which: index of the point among their A intersections.
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
    # J P_ss Jᵀ of all hypotheses: axes (hypothesis, parameter, hypothesis, parameter).
    columns = jp[:, :, 3:].reshape(count, 2, capacity, SIZE)
    jpj = jnp.einsum("cinj,nkj->cink", columns[:, :, parents[:, 0]], by_a)
    jpj = jpj + jnp.einsum("cinj,nkj->cink", columns[:, :, parents[:, 1]], by_b)
    jpj = jnp.pad(jpj, [(0, 0), (0, 1), (0, 0), (0, 1)]).reshape(SIZE * count, SIZE * count)
    # Added to rows and, transposed, to columns: half of J P_ss Jᵀ each.
    half = jnp.pad(jp, [(0, 0), (0, 1), (0, 0)]).reshape(SIZE * count, -1)
    hypothesis_rows = layout.hypothesis_rows
    half = materialize(half.at[:, hypothesis_rows].add(0.5 * jpj))
    # Padding's unit variance goes first, to an exact zero; the third parameter keeps it.
    unit = (formed[:, None] & (jnp.arange(SIZE) < 2)[None]).reshape(-1).astype(joint.cov.dtype)
    at = jnp.arange(hypothesis_rows.start, hypothesis_rows.stop)
    cov = joint.cov.at[at, at].add(-unit)
    of_hypotheses = layout.of_hypotheses
    placed = jnp.where(formed[:, None], jnp.pad(points, [(0, 0), (0, 1)]), 0.0)
    return joint._replace(
        landmarks=joint.landmarks.at[of_hypotheses].add(placed),
        cov=cov.at[hypothesis_rows].add(half).at[:, hypothesis_rows].add(half.T),
        alive=joint.alive.at[of_hypotheses].set(joint.alive[of_hypotheses] | formed),
        tag=joint.tag.at[of_hypotheses].set(
            jnp.where(formed, tag, joint.tag[of_hypotheses]).astype(jnp.int32)
        ),
    )
