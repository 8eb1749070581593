"""Sightings and hypotheses in a `Joint` beside the landmarks, for a delayed initialization.

All three have slots of one table, three parameters each: landmarks (x, y, 0) first, then hypotheses
(x, y, 0), whose third parameter is padding, then sightings (x, y, q) (`filters.meeting`). So each
is correlated with the robot, the map and each other as it truly is, and the noise of a measurement
that takes part in several intersections is one variable, never counted as independent.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filters.delayed.state import SIZE, Distance, Layout
from jaxslam.filters.delayed.triangulation import Meeting
from jaxslam.math import linalg, uncertain_poses
from jaxslam.math.uncertain_poses import Frame
from jaxslam.math.xla import settle
from jaxslam.slots import Joint

Array = jax.Array

_DISTANCES = {
    "mahalanobis": uncertain_poses.mahalanobis_squared,
    "bhattacharyya": uncertain_poses.bhattacharyya,
}


class Misses(NamedTuple):
    """By how much the points of p slots miss the sightings of q others: g(s, x) and its moments."""

    value: Array
    """(p, q) g at the estimate, 0 where point and sighting are of one landmark"""
    variance: Array
    """(p, q) of g, with the correlation of the two"""
    by_point: Array
    """(p, q, 2)"""
    by_sight: Array
    """(p, q, 3)"""

    def squared(self) -> Array:
        """(p, q) g²/var(g), infinite where the variance is none."""
        there = self.variance > 0
        ratio = self.value**2 / jnp.where(there, self.variance, 1.0)
        return jnp.where(there, ratio, jnp.inf)


def misses(joint: Joint, meeting: Meeting, points: Array, sightings: Array) -> Misses:
    """How the points of slots (p,) miss the sightings of slots (q,), each pair for itself."""
    each = jax.vmap(jax.vmap(meeting.miss, (0, None)), (None, 0))
    slopes = jax.vmap(jax.vmap(jax.jacfwd(meeting.miss, argnums=(1, 0)), (0, None)), (None, 0))
    places, seen = joint.landmarks[points, :2], joint.landmarks[sightings]
    value, (by_point, by_sight) = each(seen, places), slopes(seen, places)
    blocks = blocks_of(joint)
    rows = blocks[points][:, :2]
    own, cross = rows[jnp.arange(points.shape[0]), :, points, :2], rows[:, :, sightings]
    of_sights = blocks[sightings, :, sightings]
    variance = jnp.einsum("pqi,pij,pqj->pq", by_point, own, by_point)
    variance = variance + jnp.einsum("pqi,qij,pqj->pq", by_sight, of_sights, by_sight)
    variance = variance + 2 * jnp.einsum("pqi,piqj,pqj->pq", by_point, cross, by_sight)
    return settle(Misses(value, variance, by_point, by_sight))


class Constraints(NamedTuple):
    """m differences g (m,) that are truly zero, each of one point and one sighting."""

    value: Array
    """(m,)"""
    hp: Array
    """(m, D) H P"""
    cov: Array
    """(m, m) H P Hᵀ"""


def constraints(
    joint: Joint, points: Array, sightings: Array, value: Array, by_point: Array, by_sight: Array
) -> Constraints:
    """g (m,) of the points of slots (m,) and the sightings of slots (m,), by (m, 2) and (m, 3)."""
    capacity = joint.landmarks.shape[0]
    by_point = jnp.pad(by_point, [(0, 0), (0, SIZE - 2)])
    rows = joint.cov[3:].reshape(capacity, SIZE, -1)
    hp = jnp.einsum("mi,mid->md", by_point, rows[points])
    hp = hp + jnp.einsum("mi,mid->md", by_sight, rows[sightings])
    columns = hp[:, 3:].reshape(-1, capacity, SIZE)
    cov = jnp.einsum("mni,ni->mn", columns[:, points], by_point)
    cov = cov + jnp.einsum("mni,ni->mn", columns[:, sightings], by_sight)
    return settle(Constraints(value, hp, linalg.symmetrize(cov)))


def move_hypotheses(joint: Joint, layout: Layout, found: Constraints, do: Array) -> Joint:
    """Every hypothesis c corrected by a sighting of its own, where do (C,), and nothing else.

    g = 0 is a measurement without noise of its own (that of the sighting is in P). A hypothesis may
    be false, so of the optimal gain K = P Hᵀ/S only the rows of the hypothesis are kept (Schmidt
    1966, "Application of state-space methods to navigation problems": variables that are
    considered, not estimated). Of any gain, P ← (I - KH) P (I - KH)ᵀ is the error's covariance:

        x ← x - K g,  P ← P - K HP - (K HP)ᵀ + K S Kᵀ

    and robot, landmarks and sightings keep theirs.
    """
    count, first = layout.hypotheses, 3 + SIZE * layout.landmarks
    last = first + SIZE * count
    own = found.hp[:, first:last].reshape(count, count, SIZE)[jnp.arange(count), jnp.arange(count)]
    variance = jnp.diagonal(found.cov)
    do = do & (variance > 0)
    gain = jnp.where(do[:, None], own / jnp.where(do, variance, 1.0)[:, None], 0.0)
    change = (gain[:, :, None] * found.hp[:, None, :]).reshape(last - first, -1)
    spread = gain[:, :, None, None] * found.cov[:, None, :, None] * gain[None, None]
    half = -change.at[:, first:last].add(-0.5 * spread.reshape(last - first, last - first))
    half = settle(half)
    moved = -gain * found.value[:, None]
    at = slice(layout.landmarks, layout.first_sighting)
    return joint._replace(
        landmarks=joint.landmarks.at[at].add(moved),
        cov=joint.cov.at[first:last].add(half).at[:, first:last].add(half.T),
    )


class Meetings(NamedTuple):
    """Where q sightings meet W others."""

    points: Array
    """(q, W, A, 2)"""
    ok: Array
    """(q, W, A) bool"""
    cov: Array
    """(q, W, A, 2, 2) of the point less the position of the first sighting"""
    spread: Array
    """(q, W, A) √(largest eigenvalue of that) over the distance, infinite where not ok"""


def meetings(joint: Joint, layout: Layout, meeting: Meeting, sightings: Array) -> Meetings:
    """The sightings of slots (q,) with all W; J P Jᵀ with the joint covariance of each two.

    Relative to the sensor's position, because what the robot does not know of its own frame is no
    fault of an intersection.
    """
    first = layout.first_sighting
    seen, others = joint.landmarks[sightings], joint.landmarks[first:]

    def one(a: Array, b: Array, cov: Array) -> tuple[Array, Array, Array, Array]:
        points, ok = meeting.meet(a, b)
        by_a, by_b = jax.jacfwd(lambda a, b: meeting.meet(a, b)[0], argnums=(0, 1))(a, b)
        by_a = by_a - jnp.eye(2, SIZE, dtype=by_a.dtype)[None]
        by = jnp.concatenate([by_a, by_b], axis=2)
        own = jnp.einsum("aij,jk,alk->ail", by, cov, by)
        spread = largest_deviation(own) / _safe_norm(points - a[None, :2])
        return points, ok, own, jnp.where(ok, spread, jnp.inf)

    start = 3 + SIZE * first
    rows = joint.cov[start:, start:].reshape(layout.sightings, SIZE, layout.sightings, SIZE)
    mine = sightings - first
    own = rows[mine, :, mine]  # (q, 3, 3)
    every = jnp.arange(layout.sightings)
    theirs, cross = rows[every, :, every], rows[mine].transpose(0, 2, 1, 3)  # (q, W, 3, 3)
    q, w = cross.shape[:2]
    top = jnp.concatenate([jnp.broadcast_to(own[:, None], (q, w, SIZE, SIZE)), cross], axis=3)
    theirs = jnp.broadcast_to(theirs[None], (q, w, SIZE, SIZE))
    bottom = jnp.concatenate([cross.transpose(0, 1, 3, 2), theirs], axis=3)
    pairs = jnp.concatenate([top, bottom], axis=2)
    over = jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, 0))
    return settle(Meetings(*over(seen, others, pairs)))


def form(
    joint: Joint,
    layout: Layout,
    meeting: Meeting,
    born: Array,
    parents: Array,
    which: Array,
    tag: Array,
) -> Joint:
    """Hypotheses in the dead slots born (C,), each a meeting point of two sightings.

    x = J-linear in the two, so P_xx = J P_ss Jᵀ and its covariance with all else is J P_s·: no
    measurement's noise is counted twice, however many intersections it takes part in.

    Args:
        parents: (C, 2) slots of the two sightings.
        which: (C,) which of their A points.
        tag: (C,).
    """
    count, capacity = layout.hypotheses, layout.slots
    a, b = joint.landmarks[parents[:, 0]], joint.landmarks[parents[:, 1]]

    def point(a: Array, b: Array, which: Array) -> Array:
        return meeting.meet(a, b)[0][which]

    points = jax.vmap(point)(a, b, which)
    by_a, by_b = jax.vmap(jax.jacfwd(point, argnums=(0, 1)))(a, b, which)
    by_a, by_b = (jnp.where(born[:, None, None], by, 0.0) for by in (by_a, by_b))
    rows = joint.cov[3:].reshape(capacity, SIZE, -1)
    jp = jnp.einsum("cij,cjd->cid", by_a, rows[parents[:, 0]])
    jp = jp + jnp.einsum("cij,cjd->cid", by_b, rows[parents[:, 1]])
    columns = jp[:, :, 3:].reshape(count, 2, capacity, SIZE)
    own = jnp.einsum("cinj,nkj->cink", columns[:, :, parents[:, 0]], by_a)
    own = own + jnp.einsum("cinj,nkj->cink", columns[:, :, parents[:, 1]], by_b)
    own = jnp.pad(own, [(0, 0), (0, 1), (0, 0), (0, 1)]).reshape(SIZE * count, SIZE * count)
    first = 3 + SIZE * layout.landmarks
    last = first + SIZE * count
    half = jnp.pad(jp, [(0, 0), (0, 1), (0, 0)]).reshape(SIZE * count, -1)
    half = settle(half.at[:, first:last].add(0.5 * own))
    # Padding's unit variance goes first, to an exact zero; the third parameter keeps it.
    unit = (born[:, None] & (jnp.arange(SIZE) < 2)[None]).reshape(-1).astype(joint.cov.dtype)
    at = jnp.arange(first, last)
    cov = joint.cov.at[at, at].add(-unit)
    cov = cov.at[first:last].add(half).at[:, first:last].add(half.T)
    here = slice(layout.landmarks, layout.first_sighting)
    placed = jnp.where(born[:, None], jnp.pad(points, [(0, 0), (0, 1)]), 0.0)
    return joint._replace(
        landmarks=joint.landmarks.at[here].add(placed),
        cov=cov,
        alive=joint.alive.at[here].set(joint.alive[here] | born),
        tag=joint.tag.at[here].set(jnp.where(born, tag, joint.tag[here]).astype(jnp.int32)),
    )


def from_robot(joint: Joint, layout: Layout) -> tuple[Array, Array]:
    """Each hypothesis less the robot's position, (C, 2), and its covariance (C, 2, 2)."""
    first, count = layout.landmarks, layout.hypotheses
    own = blocks_of(joint)[first : first + count][:, :2]
    own = own[jnp.arange(count), :, first + jnp.arange(count), :2]
    cross = joint.cov[:2, 3:].reshape(2, layout.slots, SIZE)[:, first : first + count, :2]
    cross = cross.transpose(1, 0, 2)
    cov = own + joint.cov[None, :2, :2] - cross - cross.transpose(0, 2, 1)
    return joint.landmarks[first : first + count, :2] - joint.pose[None, :2], cov


def relative_spread(delta: Array, cov: Array) -> Array:
    """(…) the largest standard deviation of δ (…, 2) with covariance (…, 2, 2), over |δ|."""
    return largest_deviation(cov) / _safe_norm(delta)


def largest_deviation(cov: Array) -> Array:
    """(…) the root of the largest eigenvalue of covariances (…, 2, 2)."""
    middle = 0.5 * (cov[..., 0, 0] + cov[..., 1, 1])
    half = 0.5 * (cov[..., 0, 0] - cov[..., 1, 1])
    square = half**2 + cov[..., 0, 1] * cov[..., 1, 0]
    largest = middle + safe_root(square)
    return safe_root(largest)


def near(
    distance: Distance, limit: float, points: Array, covs: Array, others: Array, other_covs: Array
) -> Array:
    """(p, q) bool: Gaussians N(points (p, 2), covs) less than limit from others (q, 2).

    By `mahalanobis_squared` (as of independent ones) or `bhattacharyya` of `uncertain_poses`; never
    where a covariance is singular.
    """
    measure = _DISTANCES[distance]

    def frame(point: Array, cov: Array) -> Frame:
        # Points are frames whose heading is known equally well, and the same.
        inert = jnp.pad(cov, [(0, 1), (0, 1)]).at[2, 2].set(1.0)
        return Frame(jnp.pad(point, [(0, 1)]), inert)

    def one(point: Array, cov: Array, other: Array, other_cov: Array) -> Array:
        how_far, regular = measure(frame(point, cov), frame(other, other_cov))
        return regular & (how_far < limit)

    out: Array = jax.vmap(jax.vmap(one, (None, None, 0, 0)), (0, 0, None, None))(
        points, covs, others, other_covs
    )
    return settle(out)


def blocks_of(joint: Joint) -> Array:
    """P of the table as (S, 3, S, 3)."""
    capacity = joint.alive.shape[0]
    return joint.cov[3:, 3:].reshape(capacity, SIZE, capacity, SIZE)


def safe_root(square: Array) -> Array:
    """√ of what is positive, else 0; with a finite slope."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _safe_norm(delta: Array) -> Array:
    square = (delta**2).sum(axis=-1)
    return jnp.sqrt(jnp.where(square > 0, square, 1.0))
