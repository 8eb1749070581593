"""Loop closure by matching a cluster of recent landmarks with the old map.

Afterwards successive duplicates are merged: of two landmarks, one was initialized after the other
was last measured.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core._numbers import check_count
from jaxslam.core.protocols import Chart
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.map_coordinates import cov_of_coordinates
from jaxslam.filters.map_management._geometric_matching import (
    GeometricMatch,
    check_search,
    match_points,
    search_limits,
    with_unit_blocks,
)
from jaxslam.filters.map_management._merging import closest_pair, merge_landmarks, squared_distance
from jaxslam.filters.map_management._point_pairs import PointSets, difference_covs
from jaxslam.filters.map_management._relocalization import check_point_map, check_policy
from jaxslam.life import Times
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._xla import change_where, where_any
from jaxslam.math.stats import chi2_quantile


def merge_histories(joint: Joint, chart: Chart, old: Int[Array, ""], new: Int[Array, ""]) -> Joint:
    """The map with slot new merged into slot old, including their times; unchanged if equal."""
    after = merge_landmarks(joint, chart, old, new)
    known: Times = joint.life
    freed = joint.alive & ~after.alive
    happened = freed.any()

    def of_both(times: Array, value: Array) -> Array:
        return jnp.where(freed, 0, times.at[old].set(jnp.where(happened, value, times[old])))

    life = known._replace(
        born=of_both(known.born, jnp.minimum(known.born[old], known.born[new])),
        last=of_both(known.last, jnp.maximum(known.last[old], known.last[new])),
        seen=of_both(known.seen, known.seen[old] + known.seen[new]),
    )
    return after._replace(life=life)


def successive_duplicate(
    joint: Joint, chart: Chart, reach: Number, spread: Number
) -> tuple[Int[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """The older and the younger slot of the likeliest duplicates, and their squared distance.

    Of pairs within reach [m] of which one was initialized after the other was last measured, and
    whose difference is known to √(tr cov(δ)/2) <= spread [m]; infinite where there is none.
    """
    known: Times = joint.life
    capacity = joint.alive.shape[0]
    later = known.born[:, None] > known.last[None, :]
    near = ((joint.landmarks[:, None] - joint.landmarks[None, :]) ** 2).sum(axis=2) <= reach**2
    pairs = (later | later.T) & joint.alive[:, None] & joint.alive[None, :] & near

    def search(joint: Joint) -> tuple[Array, Array, Array]:
        cov = cov_of_coordinates(joint, chart)[3:, 3:].reshape(capacity, 2, capacity, 2)
        every = jnp.arange(capacity)
        traces = jnp.trace(cov[every, :, every], axis1=1, axis2=2)
        mixed = cov[:, 0, :, 0] + cov[:, 1, :, 1]
        variance = traces[:, None] + traces[None, :] - 2 * mixed
        i, j, distance = closest_pair(joint, chart, reach, pairs & (variance <= 2 * spread**2))
        first = known.born[i] <= known.born[j]
        i, j = jnp.where(first, i, j), jnp.where(first, j, i)
        return i.astype(jnp.int32), j.astype(jnp.int32), distance

    def nothing(joint: Joint) -> tuple[Array, Array, Array]:
        zero = jnp.zeros((), jnp.int32)
        return zero, zero, jnp.full((), jnp.inf, joint.cov.dtype)

    return where_any(pairs.any(), search, nothing, joint)


class LoopReport(NamedTuple):
    """The result of one search for a closed loop; `info.extra["closing"]`."""

    explained: Int[Array, ""]
    """recent landmarks that are old ones under the best hypothesis"""
    runner_up: Int[Array, ""]
    """the same under any other hypothesis"""
    likely: Bool[Array, ""]
    """the covariance of the filter, drift included, allows the best hypothesis"""
    merged: Int[Array, ""]
    """pairs of landmarks merged by the search, 0 or explained"""
    exhausted: Bool[Array, ""]
    """more pairs agreed than were tried"""
    refused: Bool[Array, ""]
    """enough landmarks match, but another hypothesis has nearly as many, or D² is too large"""
    duplicates: Int[Array, ""]
    """landmarks merged one by one, 0 or 1, by `Closing(…, reach=…)`"""


@dataclasses.dataclass(frozen=True)
class LoopSettings:
    """The settings of `close_loop`.

    Raises ValueError on counts below 1, least below 3, or probabilities not between 0 and 1.
    """

    window: int = 50
    """number of scans: a landmark is recent if one of the last `window` scans measured it"""
    cluster: int = 12
    """recent landmarks that are compared, those measured last"""
    sightings: int = 1
    """least number of scans that measured them"""
    least: int = 5
    """pairs that must agree, at least 3"""
    margin: int = 2
    """least number of matches more than under any other hypothesis"""
    probability: float = 0.99
    """of each chi-square test of the geometry"""
    drift: float = 0.9999
    """probability that the true pairs lie within the filter's covariance"""
    pairs: int = 8
    """number of pairs of recent landmarks whose distances are searched for; long ones"""
    candidates: int = 64
    """number of best agreeing pairs of old landmarks that are tried with each"""

    def __post_init__(self) -> None:
        for name in ("window", "cluster", "sightings"):
            check_count(f"LoopSettings: {name}", getattr(self, name))
        check_policy("LoopSettings", self.least, self.margin)
        if not 0 < self.drift < 1:
            raise ValueError(f"LoopSettings: expected a drift between 0 and 1, got {self.drift}")
        check_search("LoopSettings", self.probability, self.pairs, self.candidates)


def check_recency(caller: str, joint: Joint, chart: Chart) -> None:
    """Raise ValueError unless landmarks are points and their times are kept (`life.Recency`)."""
    check_point_map(caller, joint, chart)
    if not isinstance(joint.life, Times):
        raise ValueError(
            f"{caller}: expected a filter that keeps times of landmarks, as EkfSlam(…, "
            "life=life.Recency())"
        )


def close_loop(joint: Joint, chart: Chart, settings: LoopSettings) -> tuple[Joint, LoopReport]:
    """The map with recent landmarks matched with the old map and merged, and the report.

    A landmark is recent if it was measured within the last `window` scans, and it may be an old one
    only if it was initialized after that was last measured: landmarks observed over overlapping
    periods cannot be duplicates. The pair must agree with the joint covariance of both,
    δ = l_i - l_k, δᵀ cov(δ)⁻¹ δ <= χ²(2, drift). Of these pairs `match_points` finds the largest
    set of consistent geometry, whatever the drift. They are merged
    (`merging.merge_landmarks`) if there are enough of them, clearly more than any other hypothesis
    has, and D² of all δ together is at most χ²(2n, drift).
    The old slot keeps the landmark.

    The joint compatibility of Neira & Tardós 2001, on relative geometry first, so that a large
    heading error does not matter; clusters are joined as in Castellanos, Neira, Tardós, "Limits
    to the consistency of EKF-based SLAM", IAV 2004, one at a time.

    Args:
        joint: whose `life` is that of `life.Recency()`.
    Raises:
        ValueError: on a life that is not recency, or a chart, linearizer or
            landmarks that `lost` refuses.
    """
    check_recency("close_loop", joint, chart)
    recent, candidates = _recent_cluster(joint, settings)
    old, report = change_where(
        candidates.any(axis=1).sum() >= settings.least,
        lambda _: _old_slots(joint, chart, recent, candidates, settings),
        (jnp.full(recent.shape, -1, jnp.int32), no_closing()),
    )
    joint = change_where(
        report.merged > 0, lambda joint: _merge_all(joint, chart, old, recent), joint
    )
    return joint, report


def no_closing() -> LoopReport:
    """The report where nothing was searched for."""
    none, no = jnp.zeros((), jnp.int32), jnp.asarray(False)
    return LoopReport(none, none, no, none, no, no, none)


def _recent_cluster(
    joint: Joint, settings: LoopSettings
) -> tuple[Int[Array, "M"], Bool[Array, "M N"]]:
    """The slots of the M recent landmarks measured last, and their candidate old landmarks."""
    known: Times = joint.life
    capacity = joint.landmarks.shape[0]
    recent = joint.alive & (known.now - known.last <= settings.window)
    recent = recent & (known.seen >= settings.sightings)
    order = jnp.where(recent, known.last, -1) * capacity + jnp.arange(capacity)
    _, cluster = jax.lax.top_k(order, min(settings.cluster, capacity))
    later = known.born[cluster][:, None] > known.last[None, :]
    return cluster, recent[cluster][:, None] & joint.alive[None, :] & later


def _old_slots(
    joint: Joint,
    chart: Chart,
    recent: Int[Array, "M"],
    candidates: Bool[Array, "M N"],
    settings: LoopSettings,
) -> tuple[Int[Array, "M"], LoopReport]:
    """The old slot of each recent landmark, -1 without a merge, and the report."""
    capacity, m = joint.landmarks.shape[0], recent.shape[0]
    levels = jnp.asarray(
        [0.0, *(chi2_quantile(settings.drift, 2 * n) for n in range(1, settings.cluster + 1))]
    )
    limits = search_limits(
        settings.cluster, settings.probability, settings.pairs, settings.candidates
    )
    cov = cov_of_coordinates(joint, chart)[3:, 3:].reshape(capacity, 2, capacity, 2)
    within, shared = cov[recent][:, :, recent], cov[recent]
    every, each = jnp.arange(capacity), jnp.arange(m)
    delta = joint.landmarks[recent][:, None] - joint.landmarks[None]
    delta_covs = difference_covs(
        within[each, :, each], cov[every, :, every], shared.transpose(0, 2, 1, 3)
    )
    distance = jax.vmap(jax.vmap(squared_distance))(delta, delta_covs)
    allowed = candidates & (distance <= levels[1])
    points = PointSets(joint.landmarks[recent], joint.landmarks, within, cov, shared, allowed)

    def compare(_: PyTree) -> tuple[Array, LoopReport]:
        found = match_points(points, limits)
        likely = _joint_distance(delta, points, found) <= levels[found.explained]
        enough = found.explained >= settings.least
        ok = enough & (found.explained - found.runner_up >= settings.margin) & likely
        report = LoopReport(
            explained=found.explained,
            runner_up=found.runner_up,
            likely=likely,
            merged=jnp.where(ok, found.explained, 0),
            exhausted=found.exhausted,
            refused=enough & ~ok,
            duplicates=jnp.zeros((), jnp.int32),
        )
        return jnp.where(ok, found.slot, -1), report

    nothing = jnp.full(m, -1, jnp.int32), no_closing()
    return change_where(allowed.any(axis=1).sum() >= settings.least, compare, nothing)


def _merge_all(joint: Joint, chart: Chart, old: Int[Array, "M"], recent: Int[Array, "M"]) -> Joint:
    """The map with each recent landmark merged into its old one, pair by pair; -1 for none."""

    def one(joint: Joint, pair: tuple[Array, Array]) -> tuple[Joint, None]:
        kept, freed = pair
        return merge_histories(joint, chart, jnp.where(kept >= 0, kept, freed), freed), None

    return jax.lax.scan(one, joint, (old, recent))[0]


def _joint_distance(
    delta: Float[Array, "M N 2"], points: PointSets, found: GeometricMatch
) -> Float[Array, ""]:
    """The joint distance δᵀ cov(δ)⁻¹ δ of all pairs, including the drift."""
    m, paired, at = found.slot.shape[0], found.slot >= 0, jnp.maximum(found.slot, 0)
    crossed = points.cross_cov[:, :, at]
    cov = points.cluster_cov + points.map_cov[at][:, :, at]
    cov = with_unit_blocks(cov - crossed - crossed.transpose(2, 3, 0, 1), paired)
    error = jnp.where(paired[:, None], delta[jnp.arange(m), at], 0.0).reshape(2 * m)
    return squared_distance(error, linalg.symmetrize(cov.reshape(2 * m, 2 * m)))
