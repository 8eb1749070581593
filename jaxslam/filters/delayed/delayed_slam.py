"""EKF-SLAM whose landmarks are initialized late, where enough measurements of them meet."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import validation
from jaxslam.association.known import known as known_association
from jaxslam.filters.delayed.observations import confirm, intersect, take
from jaxslam.filters.delayed.promotion import promote
from jaxslam.filters.delayed.state import SIZE, Delayed, Distance, Fresh, Layout, Rules, empty
from jaxslam.filters.delayed.triangulation import Meeting, meeting_of
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.filters.ekf.scan import associate_scan
from jaxslam.filters.ekf.settings import EkfSettings
from jaxslam.filters.ekf.update import correct_in_turn
from jaxslam.filters.reporting import info_of, seen_before, status_of
from jaxslam.math.linalg import check_count, is_concrete
from jaxslam.math.stats import chi2_quantile
from jaxslam.math.xla import where_any
from jaxslam.protocols import Associate, Filter, Motion, Sensor
from jaxslam.sensors.suite import on_ground
from jaxslam.types import Estimate, Info, Scan

Array = jax.Array


class _Outcome(NamedTuple):
    """What became of the measurements of no landmark of the map, (M,) each."""

    sighted: Array
    """bool: kept as a sighting"""
    born: Array
    """int: the slot of the landmark whose last confirmation it was, or -1"""
    refused: Array
    """bool: the same, but the map is full"""


def delayed_slam(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    meet: Meeting | None = None,
    sightings: int = 32,
    hypotheses: int = 16,
    persistence: float = 4.0,
    decay: float = 0.5,
    lead: float = 2.0,
    spacing: float = 0.2,
    spread: float = 0.3,
    ready: float | None = None,
    gate: float | None = None,
    distance: Distance = "mahalanobis",
    same: float | None = None,
    patience: int = 200,
    promotions: int = 2,
    associate: Associate | None = None,
) -> Filter:
    """EKF-SLAM of bearings or ranges alone; a landmark enters where its measurements intersect.

    After Costa, Kantor & Choset, "Bearing-only landmark initialization with unknown data
    association", ICRA 2004, as Tacher §2 sums it up, with the correlations that they leave out. A
    measurement of no landmark of the map becomes a *sighting*, a variable of the map. Then

    1. it confirms the *hypotheses* it passes through: g² <= gate·var(g), g the difference of what
       it saw from what it would see of the point, with all correlations. Their persistence rises
       by 1, and they are corrected, but not the robot (`hypotheses.move_hypotheses`). Those of its
       identity that it does not confirm lose `decay`; at 0 they vanish.
    2. if it confirms none it is intersected with older sightings. Well conditioned intersections
       become hypotheses of persistence 1, unless one is there already at that place.
    3. a hypothesis of enough persistence becomes a landmark, made anew of up to eight of its
       sightings, the oldest and the newest, at once: they give its place and all its covariances,
       and what they say beyond it corrects the whole map (`initialization`). Then they leave. It
       waits where a twin fits nearly as well or the place is not sharp yet, and ends where they
       contradict each other.

    Measurements of landmarks of the map correct it, within the gate, as in `ekf_slam`. The pose's
    error is that of coordinates and Jacobians are taken at the estimate: a linearizer's memory, or
    a chart in which landmarks move, has no meaning for sightings.

    Two circles meet in two points: both become hypotheses, of one group, and none is promoted
    before it is ahead of the other by `lead` and fits its sightings clearly better than its mirror
    image does. So a range-only landmark needs a path that turns.

    Args:
        motion, sensor: the models; the sensor measures one bearing or one range of points.
        capacity: landmarks N.
        meet: how sightings meet; default `meeting.rays` or `meeting.circles`.
        sightings: places W; where full, the oldest leaves.
        hypotheses: places C; where full, intersections are refused, and counted.
        persistence: at which a hypothesis is promoted.
        decay: what it loses by a sighting that does not confirm it. Robust to so many outliers.
        lead: by how much the persistence of a hypothesis must exceed that of each of its group.
        spacing: [m] measurements of one identity become sightings only that far from each other;
            until then they are `Status.DEFERRED`.
        spread: the largest standard deviation of an intersection relative to the sensor, over their
            distance, with which a hypothesis begins: beyond, it is not Gaussian.
        ready: the same, with which it may be promoted; default `spread`.
        gate: chi-square, of one degree of freedom, of everything; default of 99 %.
        distance: between Gaussians relative to the sensor, "mahalanobis" (squared) or
            "bhattacharyya": below `same` of an existing hypothesis an intersection is that one.
        same: default the 99 % gate of two degrees of freedom, or 0.5.
        patience: scans after which a hypothesis that was not confirmed vanishes.
        promotions: at most so many a scan.
        associate: default `association.known()`, and only measurements of one tag meet. Any other
            is asked which measurement is of which landmark; those it calls new meet all others, and
            tags only name the landmarks.
    Raises:
        ValueError: on counts below 1, parameters out of range, or a sensor that does not fit.
    """
    validation.check_models("delayed_slam", motion, sensor)
    validation.check_parts("delayed_slam", associate=associate)
    _check_sensor(sensor)
    tagged = associate is None
    associate = associate or known_association()
    meeting = meeting_of(sensor) if meet is None else meet
    gate = chi2_quantile(0.99, 1) if gate is None else gate
    if same is None:
        same = chi2_quantile(0.99, 2) if distance == "mahalanobis" else 0.5
    ready = spread if ready is None else ready
    counts = {"capacity": capacity, "sightings": sightings, "hypotheses": hypotheses}
    for name, value in (counts | {"patience": patience, "promotions": promotions}).items():
        check_count(f"delayed_slam: {name}", value)
    above_zero = {"persistence": persistence, "spread": spread, "ready": ready, "gate": gate}
    not_below = {"decay": decay, "lead": lead, "spacing": spacing}
    _check_parameters(above_zero | {"same": same}, not_below)
    if not isinstance(meeting, Meeting):
        raise ValueError(f"delayed_slam: expected meet to be a Meeting, got {meeting!r}")
    if distance not in ("mahalanobis", "bhattacharyya"):
        raise ValueError(f"delayed_slam: unknown distance {distance!r}")
    layout = Layout(capacity, hypotheses, sightings)
    rules = Rules(
        layout,
        sensor,
        meeting,
        tagged,
        gate=gate,
        spacing=spacing,
        spread=spread,
        ready=ready,
        distance=distance,
        same=same,
        persistence=persistence,
        decay=decay,
        lead=lead,
        patience=patience,
    )
    seen_in_table = on_ground(sensor, SIZE)
    plain = ekf_slam(motion, seen_in_table, capacity)
    settings = EkfSettings(sensor=seen_in_table, associate=associate, gate=gate)

    def init(pose: Array, pose_cov: Array) -> Delayed:
        return empty(layout, pose, pose_cov)

    def predict(state: Delayed, u: Array, key: Array) -> Delayed:
        return state._replace(joint=plain.predict(state.joint, u, key))

    def delay(state: Delayed, scan: Fresh, names: Array) -> tuple[Delayed, _Outcome]:
        state, slot, granted = take(rules, state, scan)
        state, explained, by = confirm(rules, state, scan, slot, granted)
        lonely = granted & ~explained
        state = where_any(
            lonely.any(), lambda s: intersect(rules, s, scan, slot, lonely), lambda s: s, state
        )
        none = jnp.full(scan.tag.shape, -1, jnp.int32)

        def once(carry: Any, _: None) -> tuple[Any, None]:
            state, by, born, refused = carry
            state, by, place, home = promote(rules, state, names, by)
            here = jnp.arange(len(none)) == place
            born = jnp.where(here & (home >= 0), home, born).astype(jnp.int32)
            refused = refused | (here & (home == -1))
            return (state, by, born, refused), None

        start = state, by, none, jnp.zeros_like(scan.fresh)
        (state, _, born, refused), _ = jax.lax.scan(once, start, None, length=promotions)
        return state, _Outcome(granted, born, refused & (born < 0))

    def update(state: Delayed, scan: Scan, key: Array) -> tuple[Delayed, Info]:
        state = state._replace(clock=state.clock + 1)
        z = jnp.where(scan.valid[:, None], scan.z, 0.0)
        joint = state.joint
        landmarks = jnp.arange(layout.slots) < capacity
        shown = joint._replace(alive=joint.alive & landmarks)
        found, matched = associate_scan(shown, scan._replace(z=z), settings)
        is_new = found.is_new
        joint, done = correct_in_turn(joint, z, jnp.maximum(found.slot, 0), matched, settings)
        state = state._replace(joint=joint)
        repeated = jnp.zeros_like(is_new)
        if tagged:
            repeated = is_new & seen_before(scan.tag, is_new)
        fresh = is_new & ~repeated
        tag = scan.tag if tagged else jnp.full_like(scan.tag, -1)
        none = jnp.zeros_like(fresh)
        nothing = _Outcome(none, jnp.full(scan.tag.shape, -1, jnp.int32), none)
        if len(scan.tag) > 0:
            state, outcome = where_any(
                fresh.any(),
                lambda s: delay(s, Fresh(z, tag, fresh), scan.tag),
                lambda s: (s, nothing),
                state,
            )
        else:
            outcome = nothing
        status = status_of(
            scan.valid,
            matched=matched,
            positive=done.positive,
            inside=done.inside,
            new=is_new,
            repeated=repeated,
            granted=outcome.born >= 0,
            deferred=fresh & ~outcome.sighted & ~outcome.refused,
            stored=outcome.sighted & ~outcome.refused,
        )
        info = info_of(
            status,
            matched,
            size=1,
            slot=found.slot,
            born=outcome.born,
            nis=done.nis,
            innovation=done.innovation,
            innovation_cov=done.innovation_cov,
            log_likelihood=done.log_likelihood.sum(),
            exhausted=jnp.asarray(found.exhausted),
        )
        return state, info

    def estimate(state: Delayed) -> Estimate:
        joint, size = state.joint, 3 + SIZE * capacity
        landmarks = joint._replace(
            landmarks=joint.landmarks[:capacity],
            cov=joint.cov[:size, :size],
            alive=joint.alive[:capacity],
            tag=joint.tag[:capacity],
        )
        return plain.estimate(landmarks)

    return Filter(
        name="delayed_slam",
        control_size=len(motion.controls),
        measurement_size=1,
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=plain.chart,
    )


def _check_sensor(sensor: Sensor) -> None:
    if len(sensor.measurements) != 1 or len(sensor.landmark) != 2:
        raise ValueError(
            "delayed_slam: expected a sensor of one bearing or one range of points (x, y), got "
            f"{sensor.name} with {sensor.measurements} of {sensor.landmark}"
        )


def _check_parameters(above_zero: dict[str, Any], not_below: dict[str, Any]) -> None:
    for name, value in above_zero.items():
        if is_concrete(value) and not value > 0:
            raise ValueError(f"delayed_slam: expected {name} above 0, got {value}")
    for name, value in not_below.items():
        if is_concrete(value) and not value >= 0:
            raise ValueError(f"delayed_slam: expected {name} not below 0, got {value}")
