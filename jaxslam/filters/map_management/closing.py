"""Loops closed at the scale of a map: recent landmarks, together, are found to be old ones."""

import inspect
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import validation
from jaxslam.filters.ekf.coordinates import cov_of_coordinates
from jaxslam.filters.map_management.duplicates import double, merged
from jaxslam.filters.map_management.geometric_matching import Limits, Match, limits, match
from jaxslam.filters.map_management.point_pairs import Points
from jaxslam.filters.map_management.relocalization import check_points, check_policy
from jaxslam.math import linalg
from jaxslam.math.linalg import check_count
from jaxslam.math.stats import chi2_quantile
from jaxslam.math.xla import where_any
from jaxslam.protocols import Chart, Filter
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan

Array = jax.Array


class Closing(NamedTuple):
    """What one look after a loop found."""

    explained: Array
    """() int: recent landmarks that the best hypothesis makes old ones"""
    runner_up: Array
    """() int: as many would any other"""
    likely: Array
    """() bool: the filter's own covariance, drift and all, allows it"""
    merged: Array
    """() int: pairs of landmarks merged, 0 or explained"""
    exhausted: Array
    """() bool: more pairs agreed than were tried"""


class Closed(NamedTuple):
    """The state of a filter that closes loops."""

    joint: Joint
    closings: Array
    """() int: loops closed so far"""
    merged: Array
    """() int: landmarks that were found to be old ones, in closings"""
    doubles: Array
    """() int: landmarks merged one by one"""
    refused: Array
    """() int: looks that found enough, but not clearly more than elsewhere, or too unlikely"""
    last: Closing
    """what the last look found"""


def close_loop(
    joint: Joint,
    chart: Chart,
    *,
    window: int = 50,
    cluster: int = 12,
    sightings: int = 1,
    least: int = 5,
    margin: int = 2,
    probability: float = 0.99,
    drift: float = 0.9999,
    pairs: int = 8,
    candidates: int = 64,
) -> tuple[Joint, Closing]:
    """Match the cluster of recent landmarks with the old map, and merge what is the same.

    A landmark is recent if it was measured within the last `window` scans, and it may be an old one
    only if it was born after that was last measured: of two seen by turns neither is the other's
    double. The pair must agree with the joint covariance of both, δ = l_i - l_k, δᵀ cov(δ)⁻¹ δ <=
    χ²(2, drift), and of these `matching.match` finds the most whose geometry agrees, whatever the
    drift. They are merged (`merging.merge`) if they are enough, clearly more than any other
    hypothesis has, and D² of all δ together is at most χ²(2n, drift). The old slot keeps the
    landmark.

    The joint compatibility of Neira & Tardós 2001, on relative geometry first, so that a large
    error of the heading bends nothing; the map is joined as by Castellanos, Neira, Tardós, "Limits
    to the consistency of EKF-based SLAM", IAV 2004, one cluster at a time.

    Args:
        joint: whose `life` is that of `life.recency()`.
        window: scans.
        cluster: recent landmarks that are looked at, those measured last.
        sightings: by how many scans they must have been measured.
        least, margin, probability, pairs, candidates: as `relocalization.relocalize` has them.
        drift: probability that the true pair lies within the filter's covariance.
    Raises:
        ValueError: on counts below 1 or least below 3, probabilities not between 0 and 1, a life
            that is not recency, or a chart, linearizer or landmarks that `lost` refuses.
    """
    bounds, levels = _checked(
        window, cluster, sightings, least, margin, probability, drift, pairs, candidates
    )
    known = _times(joint, chart)
    capacity = joint.landmarks.shape[0]
    places = min(cluster, capacity)
    recent = joint.alive & (known.now - known.last <= window) & (known.seen >= sightings)
    order = jnp.where(recent, known.last, -1) * capacity + jnp.arange(capacity)
    _, chosen = jax.lax.top_k(order, places)
    later = known.born[chosen][:, None] > known.last[None, :]
    maybe = recent[chosen][:, None] & joint.alive[None, :] & later

    def look(joint: Joint) -> tuple[Joint, Closing]:
        cov = cov_of_coordinates(joint, chart)[3:, 3:].reshape(capacity, 2, capacity, 2)
        here, every = joint.landmarks[chosen], jnp.arange(capacity)
        own, shared = cov[chosen][:, :, chosen], cov[chosen]
        alone = own[jnp.arange(places), :, jnp.arange(places)]
        mixed = shared.transpose(0, 2, 1, 3)
        spread = alone[:, None] + cov[every, :, every][None] - mixed - mixed.transpose(0, 1, 3, 2)
        delta = here[:, None] - joint.landmarks[None]
        apart = jax.vmap(jax.vmap(_distance))(delta, spread)
        allowed = maybe & (apart <= levels[1])
        enough = allowed.any(axis=1).sum() >= least
        points = Points(here, joint.landmarks, own, cov, shared, allowed)

        def compare(joint: Joint) -> tuple[Joint, Closing]:
            found = match(points, bounds)
            likely = _jointly(delta, points, found) <= levels[found.explained]
            clear = (found.explained >= least) & (found.explained - found.runner_up >= margin)
            ok = enough & clear & likely
            slot = jnp.where(ok, found.slot, -1)

            def one(joint: Joint, pair: tuple[Array, Array]) -> tuple[Joint, None]:
                old, new = pair
                return merged(joint, chart, jnp.where(old >= 0, old, new), new), None

            joint = where_any(
                ok,
                lambda joint: jax.lax.scan(one, joint, (slot, chosen))[0],
                lambda joint: joint,
                joint,
            )
            return joint, Closing(
                explained=jnp.where(enough, found.explained, 0),
                runner_up=jnp.where(enough, found.runner_up, 0),
                likely=likely & enough,
                merged=jnp.where(ok, found.explained, 0),
                exhausted=found.exhausted & enough,
            )

        return where_any(enough, compare, lambda joint: (joint, _no_look()), joint)

    possible = maybe.any(axis=1).sum() >= least
    return where_any(possible, look, lambda joint: (joint, _no_look()), joint)


_OPTIONS: dict[str, Any] = {
    name: parameter.default
    for name, parameter in inspect.signature(close_loop).parameters.items()
    if parameter.kind is parameter.KEYWORD_ONLY
}
"""What `close_loop` may be told, with what it does where it is not."""


def closing(
    filter: Filter,
    *,
    every: int = 1,
    reach: float | None = None,
    spread: float = 0.5,
    **options: Any,
) -> Filter:
    """A filter that looks after each scan whether a loop has closed.

    Its state is a `Closed`, with the other filter's `Joint` in it and counts of what was merged; a
    landmark merged counts as removed in `Info.removed`. The other filter must be an
    `ekf_slam(…, life=life.recency(), associate=association.certain(…))` or the like.

    Args:
        filter: the filter.
        every: scans from one look to the next.
        reach: [m] where given, two landmarks closer than that, of which one was born after the
            other was last measured, are merged if δ = 0 is within 99 % and √(tr cov(δ)/2) is at
            most spread, one pair a scan. So come home those that were born before the loop closed.
        spread: [m]
        **options: of `close_loop`.
    Raises:
        ValueError: on a square-root filter, on every below 1, a reach or spread not above 0, an
            option that `close_loop` does not have or refuses, and, when it starts, on a life that
            is not recency.
    """
    check_count("closing: every", every)
    unknown = sorted(set(options) - set(_OPTIONS))
    if unknown:
        raise ValueError(f"closing: expected options of close_loop, got {', '.join(unknown)}")
    chosen = _OPTIONS | options
    _checked(**chosen)
    if not (reach is None or reach > 0) or not spread > 0:
        raise ValueError(f"closing: expected a reach and a spread above 0, got {reach}, {spread}")
    if filter.square_root:
        raise ValueError(f"closing: the state of {filter.name} holds a root of its covariance")
    chart, gate = filter.chart, chi2_quantile(0.99, 2)

    def init(pose: Array, pose_cov: Array) -> Closed:
        joint, none = filter.init(pose, pose_cov), jnp.zeros((), jnp.int32)
        if not isinstance(joint, Joint):
            raise ValueError(f"closing: the state of {filter.name} is no slots.Joint")
        _times(joint, chart)
        return Closed(joint, none, none, none, none, _no_look())

    def predict(state: Closed, u: Array, key: Array) -> Closed:
        return state._replace(joint=filter.predict(state.joint, u, key))

    def update(state: Closed, scan: Scan, key: Array) -> tuple[Closed, Info]:
        found = filter.update(state.joint, scan, key)
        joint, info = validation.state_and_info(f"closing: {filter.name}", state.joint, scan, found)
        before = joint.alive
        due = (joint.life.now % every == 0) & scan.valid.any()

        def look(joint: Joint) -> tuple[Joint, Closing]:
            joint_after, report = close_loop(joint, chart, **chosen)
            # Of a batch, the runs that are not due look too, and keep what they had.
            both: tuple[Joint, Closing] = jax.tree.map(
                lambda a, b: jnp.where(due, a, b), (joint_after, report), (joint, _no_look())
            )
            return both

        joint, report = where_any(due, look, lambda joint: (joint, _no_look()), joint)
        doubles = jnp.zeros((), jnp.int32)
        if reach is not None:
            i, j, near = double(joint, chart, reach, spread)
            twice = near <= gate
            joint = where_any(
                twice,
                lambda joint: merged(joint, chart, jnp.where(twice, i, j), j),
                lambda joint: joint,
                joint,
            )
            doubles = twice.astype(jnp.int32)
        info = info._replace(removed=info.removed | (before & ~joint.alive))
        tried = report.explained >= chosen["least"]
        done = report.merged > 0
        return Closed(
            joint=joint,
            closings=state.closings + done,
            merged=state.merged + report.merged,
            doubles=state.doubles + doubles,
            refused=state.refused + (tried & ~done),
            last=report,
        ), info

    def estimate(state: Closed) -> Estimate:
        return filter.estimate(state.joint)

    return Filter(
        name=f"closing {filter.name}",
        control_size=filter.control_size,
        measurement_size=filter.measurement_size,
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=chart,
        places=filter.places,
    )


def _checked(
    window: int,
    cluster: int,
    sightings: int,
    least: int,
    margin: int,
    probability: float,
    drift: float,
    pairs: int,
    candidates: int,
) -> tuple[Limits, Array]:
    for name, value in (("window", window), ("cluster", cluster), ("sightings", sightings)):
        check_count(f"close_loop: {name}", value)
    check_policy("close_loop", least, margin)
    if not 0 < drift < 1:
        raise ValueError(f"close_loop: expected a drift between 0 and 1, got {drift}")
    bounds = limits("close_loop", cluster, probability, pairs, candidates)
    levels = [0.0, *(chi2_quantile(drift, 2 * n) for n in range(1, cluster + 1))]
    return bounds, jnp.asarray(np.asarray(levels))


def _times(joint: Joint, chart: Chart) -> Any:
    check_points("close_loop", joint, chart)
    if not hasattr(joint.life, "born") or not hasattr(joint.life, "last"):
        raise ValueError("close_loop: expected a filter with life=life.recency()")
    return joint.life


def _no_look() -> Closing:
    none, no = jnp.zeros((), jnp.int32), jnp.asarray(False)
    return Closing(none, none, no, none, no)


def _distance(delta: Array, cov: Array) -> Array:
    factor, positive = linalg.cholesky(cov)
    return jnp.where(positive, (linalg.solve_lower(factor, delta) ** 2).sum(), jnp.inf)


def _jointly(delta: Array, points: Points, found: Match) -> Array:
    """δᵀ cov(δ)⁻¹ δ over all pairs found, with the drift in it."""
    m = found.slot.shape[0]
    there, at = found.slot >= 0, jnp.maximum(found.slot, 0)
    crossed = points.shared[:, :, at]
    spread = points.own + points.among[at][:, :, at] - crossed - crossed.transpose(2, 3, 0, 1)
    both = there[:, None, None, None] & there[None, None, :, None]
    unit = jnp.eye(2 * m, dtype=spread.dtype).reshape(m, 2, m, 2)
    spread = jnp.where(jnp.broadcast_to(both, spread.shape), spread, unit).reshape(2 * m, 2 * m)
    error = jnp.where(there[:, None], delta[jnp.arange(m), at], 0.0).reshape(2 * m)
    return _distance(error, linalg.symmetrize(spread))
