"""EKF-SLAM whose landmarks are initialized late, where enough measurements of them intersect."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxslam import validation
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters.delayed.confirmation import confirm_hypotheses
from jaxslam.filters.delayed.intersection import intersect_measurements
from jaxslam.filters.delayed.promotion import Promoted, promote_hypotheses
from jaxslam.filters.delayed.settings import (
    DelayedSettings,
    Hypotheses,
    Promotion,
    StoredMeasurements,
)
from jaxslam.filters.delayed.state import (
    SIZE,
    DelayedState,
    NewMeasurements,
    TableLayout,
    empty_state,
)
from jaxslam.filters.delayed.stored_measurements import store_measurements
from jaxslam.filters.delayed.triangulation import Triangulation, triangulation_of
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.filters.ekf.innovation import Correction
from jaxslam.filters.ekf.predicted_measurements import prediction_of
from jaxslam.filters.ekf.update import correct_in_turn
from jaxslam.filters.reporting import info_of, seen_before, status_of
from jaxslam.linearize.at_estimate import at_estimate
from jaxslam.math.linalg import check_count, is_concrete
from jaxslam.math.stats import chi2_quantile
from jaxslam.math.xla import where_any
from jaxslam.protocols import Associate, Association, Filter, Motion, Sensor
from jaxslam.sensors.suite import on_ground
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan


def delayed_slam(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    triangulation: Triangulation | None = None,
    stored: StoredMeasurements | None = None,
    hypotheses: Hypotheses | None = None,
    promotion: Promotion | None = None,
    gate: float | None = None,
    associate: Associate | None = None,
) -> Filter:
    """EKF-SLAM of bearings or ranges alone; a landmark enters where its measurements intersect.

    After Costa, Kantor & Choset, "Bearing-only landmark initialization with unknown data
    association", ICRA 2004, as Tacher §2 sums it up, with the correlations that they leave out.
    Measurements of landmarks of the map correct it, within the gate, as in `ekf_slam`. One of no
    landmark of the map becomes a *stored measurement*, a variable of the map (`state` has a
    diagram). Then

    1. it confirms the *hypotheses* it passes through: g² <= gate·var(g), g the difference of what
       it saw from what it would see of the point, with all correlations. Their persistence rises
       by 1, and they are corrected, but not the robot (`confirmation.correct_hypotheses`). Those of
       its tag that it does not confirm lose `decay`; at 0 they are deleted.
    2. if it confirms none it is intersected with older stored measurements. Well conditioned
       intersections become hypotheses of persistence 1, unless one is there already at that place.
    3. a hypothesis of enough persistence becomes a landmark, made anew of up to eight of its
       stored measurements, the oldest and the newest, at once: they give its place and all its
       covariances, and what they say beyond it corrects the whole map (`initialization`). Then they
       are marginalized out. It waits where its mirror solution fits nearly as well or its place is
       not sharp yet, and is deleted where they contradict each other.

    The pose's error is that of coordinates and Jacobians are taken at the estimate: a linearizer's
    memory, or a chart in which landmarks move, has no meaning for stored measurements.

    Two circles intersect in two points: both become hypotheses, of one group, and none is promoted
    before it is ahead of the other by `lead` and fits its measurements clearly better than its
    mirror solution does. So a range-only landmark needs a path that turns.

    Args:
        motion, sensor: the models; the sensor measures one bearing or one range of points.
        capacity: landmarks N.
        triangulation: how stored measurements intersect; default `triangulation.rays` or
            `triangulation.circles`, by what the sensor measures.
        stored, hypotheses, promotion: `settings.StoredMeasurements`, `settings.Hypotheses` and
            `settings.Promotion`, which say what they are for; default all defaults.
        gate: chi-square, of one degree of freedom, of every comparison; default that of 99 %.
        associate: default `association.known()`, and only measurements of one tag intersect. Any
            other is asked which measurement is of which landmark; those it calls new intersect all
            others, and tags only name the landmarks.
    Raises:
        ValueError: on a capacity below 1, a gate not above 0, a part of another kind, or a sensor
            that does not fit.
    """
    settings = _settings(
        motion,
        sensor,
        capacity,
        triangulation=triangulation,
        stored=stored,
        hypotheses=hypotheses,
        promotion=promotion,
        gate=gate,
        associate=associate,
    )
    associate = associate or known_association()
    layout, table_sensor = settings.layout, on_ground(sensor, SIZE)
    chart, linearize = euclidean(), at_estimate()
    ekf = ekf_slam(motion, table_sensor, capacity)

    def init(pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> DelayedState:
        return empty_state(layout, pose, pose_cov)

    def predict(state: DelayedState, u: Float[Array, "U"], key: Array) -> DelayedState:
        return state._replace(joint=ekf.predict(state.joint, u, key))

    def update(state: DelayedState, scan: Scan, key: Array) -> tuple[DelayedState, Info]:
        # Padding may hold anything, and is multiplied by zero further down.
        scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
        # Associate with the landmarks of the map.
        prediction = prediction_of(
            _landmarks_alone(state.joint, capacity),
            sensor=table_sensor,
            chart=chart,
            linearize=linearize,
        )
        found = Association(*associate(prediction, scan))
        matched = scan.valid & (found.slot >= 0) & ~found.is_new
        # Gate and correct.
        joint, correction = correct_in_turn(
            state.joint,
            scan.z,
            jnp.maximum(found.slot, 0),
            matched,
            sensor=table_sensor,
            chart=chart,
            linearize=linearize,
            gate=settings.gate,
        )
        state = state._replace(joint=joint, clock=state.clock + 1)
        new = _new_measurements(settings, scan, found)

        def initialize(state: DelayedState) -> tuple[DelayedState, _Outcome]:
            state, slot, stored = store_measurements(settings, state, new)
            state, explained, by = confirm_hypotheses(settings, state, new, slot, stored)
            state = intersect_measurements(settings, state, new, slot, stored & ~explained)
            state, promoted = promote_hypotheses(settings, state, new, by)
            return state, _Outcome(stored, promoted)

        def leave(state: DelayedState) -> tuple[DelayedState, _Outcome]:
            nobody = jnp.zeros_like(new.is_new)
            none = jnp.full(scan.tag.shape, -1, jnp.int32)
            return state, _Outcome(nobody, Promoted(none, nobody))

        steps = initialize if len(scan.tag) > 0 else leave
        state, outcome = where_any(new.wanted.any(), steps, leave, state)
        return state, _report(scan, found, matched, correction, new, outcome)

    def estimate(state: DelayedState) -> Estimate:
        joint, size = state.joint, 3 + SIZE * capacity
        landmarks = joint._replace(
            landmarks=joint.landmarks[:capacity],
            cov=joint.cov[:size, :size],
            alive=joint.alive[:capacity],
            tag=joint.tag[:capacity],
        )
        return ekf.estimate(landmarks)

    return Filter(
        name="delayed_slam",
        control_size=len(motion.controls),
        measurement_size=1,
        init=init,
        predict=predict,
        update=update,
        estimate=estimate,
        chart=ekf.chart,
    )


class _Outcome(NamedTuple):
    """What became of the new measurements of a scan."""

    stored: Bool[Array, "M"]
    promoted: Promoted


def _landmarks_alone(joint: Joint, capacity: int) -> Joint:
    """The joint as association sees it: hypotheses and stored measurements are no landmarks."""
    return joint._replace(alive=joint.alive & (jnp.arange(len(joint.alive)) < capacity))


def _new_measurements(settings: DelayedSettings, scan: Scan, found: Association) -> NewMeasurements:
    """The measurements of a scan that association calls new."""
    is_new = scan.valid & found.is_new
    if settings.by_tag:
        return NewMeasurements(scan.z, scan.tag, scan.tag, is_new, seen_before(scan.tag, is_new))
    unknown = jnp.full_like(scan.tag, -1)
    return NewMeasurements(scan.z, unknown, scan.tag, is_new, jnp.zeros_like(is_new))


def _report(
    scan: Scan,
    found: Association,
    matched: Bool[Array, "M"],
    correction: Correction,
    new: NewMeasurements,
    outcome: _Outcome,
) -> Info:
    """What became of each measurement of a scan."""
    slot, refused = outcome.promoted
    status = status_of(
        scan.valid,
        matched=matched,
        positive=correction.positive,
        inside=correction.inside,
        new=new.is_new,
        repeated=new.repeated,
        granted=slot >= 0,
        deferred=new.wanted & ~outcome.stored & ~refused,
        stored=outcome.stored & ~refused,
    )
    return info_of(
        status,
        matched,
        size=1,
        slot=found.slot,
        born=slot,
        nis=correction.nis,
        innovation=correction.innovation,
        innovation_cov=correction.innovation_cov,
        log_likelihood=correction.log_likelihood.sum(),
        exhausted=jnp.asarray(found.exhausted),
    )


def _settings(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    triangulation: Triangulation | None,
    stored: StoredMeasurements | None,
    hypotheses: Hypotheses | None,
    promotion: Promotion | None,
    gate: float | None,
    associate: Associate | None,
) -> DelayedSettings:
    """The settings of `delayed_slam`, checked, with its defaults."""
    name = "delayed_slam"
    validation.check_models(name, motion, sensor)
    validation.check_parts(name, associate=associate)
    if len(sensor.measurements) != 1 or len(sensor.landmark) != 2:
        raise ValueError(
            f"{name}: expected a sensor of one bearing or one range of points (x, y), got "
            f"{sensor.name} with {sensor.measurements} of {sensor.landmark}"
        )
    check_count(f"{name}: capacity", capacity)
    gate = chi2_quantile(0.99, 1) if gate is None else gate
    if is_concrete(gate) and not gate > 0:
        raise ValueError(f"{name}: expected gate above 0, got {gate}")
    triangulation = triangulation_of(sensor) if triangulation is None else triangulation
    stored = StoredMeasurements() if stored is None else stored
    hypotheses = Hypotheses() if hypotheses is None else hypotheses
    promotion = Promotion() if promotion is None else promotion
    validation.check_record(name, "triangulation", triangulation, Triangulation)
    validation.check_record(name, "stored", stored, StoredMeasurements)
    validation.check_record(name, "hypotheses", hypotheses, Hypotheses)
    validation.check_record(name, "promotion", promotion, Promotion)
    return DelayedSettings(
        sensor=sensor,
        triangulation=triangulation,
        layout=TableLayout(capacity, hypotheses.capacity, stored.capacity),
        by_tag=associate is None,
        gate=gate,
        stored=stored,
        hypotheses=hypotheses,
        promotion=promotion,
    )
