"""Loop closure by matching a cluster of recent landmarks with the old map, and the merging of
successive duplicates, two landmarks one of which was initialized after the last measurement of the
second."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core.protocols import Chart
from jaxslam.core.slots import Joint
from jaxslam.core.validation import InvalidField, at_least, in_range, refusals_of, require
from jaxslam.filters._ekf.map_coordinates import cov_of_coordinates
from jaxslam.filters.map_management._geometric_matching import (
    GeometricMatch,
    check_point_map,
    check_search,
    match_points,
    search_limits,
    with_unit_blocks,
)
from jaxslam.filters.map_management._merging import closest_pair, merge_landmarks, squared_distance
from jaxslam.filters.map_management._point_pairs import PointSets, difference_covs
from jaxslam.life import Times
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._xla import change_where, where_any
from jaxslam.math.stats import chi2_quantile


def merge_histories(joint: Joint, chart: Chart, old: Int[Array, ""], new: Int[Array, ""]) -> Joint:
    """The map with slot new merged into slot old, including their times; unchanged if equal."""
    after = merge_landmarks(joint, chart, old, new)
    times: Times = joint.life
    freed = joint.alive & ~after.alive
    merged = freed.any()

    def merge(column: Array, value: Array) -> Array:
        return jnp.where(freed, 0, column.at[old].set(jnp.where(merged, value, column[old])))

    life = times._replace(
        born=merge(times.born, jnp.minimum(times.born[old], times.born[new])),
        last=merge(times.last, jnp.maximum(times.last[old], times.last[new])),
        seen=merge(times.seen, times.seen[old] + times.seen[new]),
    )
    return after._replace(life=life)


def successive_duplicate(
    joint: Joint, chart: Chart, reach: Number, spread: Number
) -> tuple[Int[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """The older and the younger slot of the likeliest duplicates, and their squared distance.

    Two landmarks within reach [m] may be duplicates if one was initialized after the last
    measurement of the second, and √(tr cov(δ)/2) of their difference is at most spread [m]. The
    distance is infinite where there is no such pair.
    """
    times: Times = joint.life
    capacity = joint.alive.shape[0]
    later = times.born[:, None] > times.last[None, :]
    near = ((joint.landmarks[:, None] - joint.landmarks[None, :]) ** 2).sum(axis=2) <= reach**2
    pairs = (later | later.T) & joint.alive[:, None] & joint.alive[None, :] & near

    def search(joint: Joint) -> tuple[Array, Array, Array]:
        # tr cov(l_i - l_j) = tr P_ii + tr P_jj - 2 tr P_ij.
        cov = cov_of_coordinates(joint, chart)[3:, 3:].reshape(capacity, 2, capacity, 2)
        k = jnp.arange(capacity)
        traces = jnp.trace(cov[k, :, k], axis1=1, axis2=2)
        mixed = cov[:, 0, :, 0] + cov[:, 1, :, 1]
        # Its mean over x and y is to be at most spread², hence the 2 below.
        variance = traces[:, None] + traces[None, :] - 2 * mixed
        i, j, distance = closest_pair(joint, chart, reach, pairs & (variance <= 2 * spread**2))
        first = times.born[i] <= times.born[j]
        i, j = jnp.where(first, i, j), jnp.where(first, j, i)
        return i.astype(jnp.int32), j.astype(jnp.int32), distance

    def nothing(joint: Joint) -> tuple[Array, Array, Array]:
        zero = jnp.zeros((), jnp.int32)
        return zero, zero, jnp.full((), jnp.inf, joint.cov.dtype)

    return where_any(pairs.any(), search, nothing, joint)


class LoopReport(NamedTuple):
    """The result of one search for a closed loop; `info.extra["closing"]`."""

    explained: Int[Array, ""]
    """number of recent landmarks matched with old landmarks by the best hypothesis"""
    runner_up: Int[Array, ""]
    """number of recent landmarks explained by the second-best hypothesis"""
    likely: Bool[Array, ""]
    """the covariance of the filter, drift included, allows the best hypothesis"""
    merged: Int[Array, ""]
    """number of pairs of landmarks merged by the search, 0 or explained"""
    exhausted: Bool[Array, ""]
    """more pairs agreed than were tried"""
    refused: Bool[Array, ""]
    """enough landmarks match, but the second-best hypothesis has nearly as many, or D² is too
    large"""
    duplicates: Int[Array, ""]
    """number of successive duplicates merged, 0 or 1, by `Closing(…, reach=…)`"""


@dataclasses.dataclass(frozen=True)
class LoopSettings:
    """The settings of `close_loop`.

    Raises ValueError on counts below 1, least below 3, or probabilities not between 0 and 1.
    """

    window: int = 50
    """number of scans: a landmark is recent if one of the last `window` scans measured it"""
    cluster: int = 12
    """number of recent landmarks that are compared, those measured last"""
    sightings: int = 1
    """least number of scans that measured a recent landmark"""
    least: int = 5
    """least number of pairs that agree, at least 3"""
    margin: int = 2
    """least difference to the number of matches of the second-best hypothesis"""
    probability: float = 0.99
    """probability of each chi-square test of the geometry"""
    drift: float = 0.9999
    """probability that the true pairs lie within the filter's covariance"""
    pairs: int = 8
    """number of pairs of recent landmarks, long ones, whose distances are searched for"""
    candidates: int = 64
    """number of best agreeing pairs of old landmarks tried with each of these"""

    def __post_init__(self) -> None:
        with refusals_of("LoopSettings"):
            for name in ("window", "cluster", "sightings"):
                require(name, getattr(self, name), at_least(1))
            require("drift", self.drift, in_range(0.0, 1.0, open=True))
            check_search(self.least, self.margin, self.probability, self.pairs, self.candidates)


def check_recency(joint: Joint) -> None:
    """Raise InvalidField unless landmarks are points and their times are kept (`life.Recency`)."""
    check_point_map(joint)
    if not isinstance(joint.life, Times):
        reason = "expected that of a filter that keeps times, as EkfSlam(…, life=life.Recency())"
        raise InvalidField("joint", reason)


def close_loop(joint: Joint, chart: Chart, settings: LoopSettings) -> tuple[Joint, LoopReport]:
    """The map with recent landmarks matched with the old map and merged, and the report.

    A landmark is recent if it was measured within the last `window` scans. It may be the duplicate
    of an old landmark only if it was initialized after the last measurement of that landmark:
    landmarks observed over overlapping periods cannot be duplicates. The pair must agree with the
    joint covariance of both, δ = l_i - l_k, δᵀ cov(δ)⁻¹ δ <= χ²(2, drift). Of these pairs
    `match_points` finds the largest set of consistent geometry, for any drift. They are merged
    (`merge_landmarks`) if there are enough of them, clearly more than of the second-best
    hypothesis, and D² of all δ together is at most χ²(2n, drift). The old slot keeps the landmark.

    The joint compatibility of Neira & Tardós 2001, on relative geometry first, so that a large
    heading error does not matter; clusters are joined as in Castellanos, Neira, Tardós, "Limits
    to the consistency of EKF-based SLAM", IAV 2004, one at a time.

    Args:
        joint: a map whose `life` is the memory of `life.Recency()`.
    Raises:
        ValueError: on a life that is not recency, or landmarks or a linearizer that `lost`
            refuses.
    """
    with refusals_of("close_loop"):
        check_recency(joint)
    times: Times = joint.life
    capacity = joint.landmarks.shape[0]
    is_recent = joint.alive & (times.now - times.last <= settings.window)
    is_recent = is_recent & (times.seen >= settings.sightings)
    # The cluster: by the time of the last measurement, then by the slot.
    # A number of its own for each slot, in int32 for 2³¹/N scans.
    order = jnp.where(is_recent, times.last, -1) * capacity + jnp.arange(capacity)
    _, recent = jax.lax.top_k(order, min(settings.cluster, capacity))
    later = times.born[recent][:, None] > times.last[None, :]
    candidates = is_recent[recent][:, None] & joint.alive[None, :] & later
    # Each test before the search costs less than the search: most scans end here.
    old, report = change_where(
        candidates.any(axis=1).sum() >= settings.least,
        lambda _: _match_cluster(joint, chart, recent, candidates, settings),
        (jnp.full(recent.shape, -1, jnp.int32), no_closing()),
    )

    def merge(joint: Joint, pair: tuple[Array, Array]) -> tuple[Joint, None]:
        kept, freed = pair
        # A landmark merged into itself is not changed.
        return merge_histories(joint, chart, jnp.where(kept >= 0, kept, freed), freed), None

    def merge_all(joint: Joint) -> Joint:
        return jax.lax.scan(merge, joint, (old, recent))[0]

    return change_where(report.merged > 0, merge_all, joint), report


def no_closing() -> LoopReport:
    """The report where nothing was searched for."""
    none, no = jnp.zeros((), jnp.int32), jnp.asarray(False)
    return LoopReport(none, none, no, none, no, no, none)


def _match_cluster(
    joint: Joint,
    chart: Chart,
    recent: Int[Array, "M"],
    candidates: Bool[Array, "M N"],
    settings: LoopSettings,
) -> tuple[Int[Array, "M"], LoopReport]:
    """The old slot of each recent landmark, -1 without a merge, and the report."""
    capacity, m = joint.landmarks.shape[0], recent.shape[0]
    # χ² by the number of pairs; no pair has the distance 0.
    levels = jnp.asarray(
        [0.0, *(chi2_quantile(settings.drift, 2 * n) for n in range(1, settings.cluster + 1))]
    )
    limits = search_limits(
        settings.cluster, settings.probability, settings.pairs, settings.candidates
    )
    cov = cov_of_coordinates(joint, chart)[3:, 3:].reshape(capacity, 2, capacity, 2)
    cluster_cov, cross_cov = cov[recent][:, :, recent], cov[recent]
    i, k = jnp.arange(m), jnp.arange(capacity)
    delta = joint.landmarks[recent][:, None] - joint.landmarks[None]
    delta_covs = difference_covs(
        cluster_cov[i, :, i], cov[k, :, k], cross_cov.transpose(0, 2, 1, 3)
    )
    distance = jax.vmap(jax.vmap(squared_distance))(delta, delta_covs)
    allowed = candidates & (distance <= levels[1])
    points = PointSets(
        joint.landmarks[recent], joint.landmarks, cluster_cov, cov, cross_cov, allowed
    )

    def compare(_: PyTree) -> tuple[Array, LoopReport]:
        match = match_points(points, limits)
        likely = _joint_distance(delta, points, match) <= levels[match.explained]
        enough = match.explained >= settings.least
        ok = enough & (match.explained - match.runner_up >= settings.margin) & likely
        report = LoopReport(
            explained=match.explained,
            runner_up=match.runner_up,
            likely=likely,
            merged=jnp.where(ok, match.explained, 0),
            exhausted=match.exhausted,
            refused=enough & ~ok,
            duplicates=jnp.zeros((), jnp.int32),
        )
        return jnp.where(ok, match.slot, -1), report

    nothing = jnp.full(m, -1, jnp.int32), no_closing()
    return change_where(allowed.any(axis=1).sum() >= settings.least, compare, nothing)


def _joint_distance(
    delta: Float[Array, "M N 2"], points: PointSets, match: GeometricMatch
) -> Float[Array, ""]:
    """The joint distance δᵀ cov(δ)⁻¹ δ of all pairs, including the drift."""
    m, paired, at = match.slot.shape[0], match.slot >= 0, jnp.maximum(match.slot, 0)
    # (M, 2, M, 2): recent landmark and entry, old landmark of each pair and entry.
    crossed = points.cross_cov[:, :, at]
    cov = points.cluster_cov + points.map_cov[at][:, :, at]
    cov = with_unit_blocks(cov - crossed - crossed.transpose(2, 3, 0, 1), paired)
    error = jnp.where(paired[:, None], delta[jnp.arange(m), at], 0.0).reshape(2 * m)
    return squared_distance(error, linalg.symmetrize(cov.reshape(2 * m, 2 * m)))
