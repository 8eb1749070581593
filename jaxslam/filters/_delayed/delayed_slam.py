"""EKF-SLAM with delayed initialization of landmarks, from intersections of measurements."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core import _validation as validation
from jaxslam.core import slots
from jaxslam.core._record import hold_function, record, set_field, static
from jaxslam.core.protocols import Associate, Association, Filter, Motion, Sensor
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.filters._delayed.confirmation import confirm_hypotheses
from jaxslam.filters._delayed.delayed_settings import (
    DelayedSettings,
    Hypotheses,
    Promotion,
    StoredMeasurements,
)
from jaxslam.filters._delayed.intersection import intersect_measurements
from jaxslam.filters._delayed.promotion import Promoted, promote_hypotheses
from jaxslam.filters._delayed.state import (
    SIZE,
    DelayedState,
    NewMeasurements,
    TableLayout,
    delete_slots_if_any,
    empty_state,
    increased,
    is_newer,
    slots_where,
)
from jaxslam.filters._delayed.triangulation import Triangulation, triangulation_of
from jaxslam.filters._ekf.correction import Correction, correct_in_turn
from jaxslam.filters._ekf.ekf_slam import EkfSlam, associate_scan
from jaxslam.filters._ekf.map_coordinates import estimate_of
from jaxslam.filters._ekf.predicted_measurements import prediction_of
from jaxslam.filters._reporting import info_of, status_of
from jaxslam.math._arrays import Number
from jaxslam.math._xla import where_any
from jaxslam.math.stats import chi2_quantile
from jaxslam.sensors._suite import on_ground


def _store_measurements(
    settings: DelayedSettings, state: DelayedState, new: NewMeasurements
) -> tuple[DelayedState, Int[Array, "M"], Bool[Array, "M"]]:
    """The state with new measurements stored; their slots, and which were stored.

    One is stored if the sensor is far enough from its positions at other measurements of the same
    tag. Where the table is full the oldest are marginalized out.
    """
    layout, joint = settings.layout, state.joint
    store = partial(settings.triangulation.store, settings.sensor)
    values = jax.vmap(store, (None, 0))(joint.pose, new.z)
    by_pose, by_z = jax.vmap(jax.jacfwd(store, argnums=(0, 1)), (None, 0))(joint.pose, new.z)
    alive, tag = joint.alive[layout.of_stored], joint.tag[layout.of_stored]
    offset = values[:, None, :2] - joint.landmarks[None, layout.of_stored, :2]
    close = ((offset**2).sum(axis=2) < settings.stored.spacing**2) & alive[None]
    wanted = new.wanted & ~(close & (new.tag[:, None] == tag[None])).any(axis=1)

    needed = wanted.sum() - (~alive).sum()
    age = jnp.where(alive, state.taken_at, state.clock + 1)
    evicted = alive & (is_newer(age).sum(axis=0) < needed)
    state = delete_slots_if_any(layout, state, slots_where(layout, stored=evicted))

    joint = state.joint
    place, stored = slots.allocate(joint.alive[layout.of_stored], wanted)
    noise_cov = jax.vmap(settings.sensor.noise_cov)(new.z)
    own_cov = jnp.einsum("mij,mjk,mlk->mil", by_z, noise_cov, by_z)
    slot = layout.first_stored + place
    joint = slots.scatter(joint, slot, stored, values, by_pose, own_cov, new.tag)
    at = jnp.where(stored, place, layout.stored)  # beyond the end: dropped
    state = state._replace(
        joint=joint,
        taken_at=state.taken_at.at[at].set(state.clock, mode="drop"),
        noise_var=state.noise_var.at[at].set(own_cov[:, 2, 2], mode="drop"),
        counts=state.counts._replace(evicted=increased(state.counts.evicted, evicted)),
    )
    return state, slot, stored


@record
class DelayedSlam(Filter):
    """EKF-SLAM with bearings only or ranges only, and delayed initialization of landmarks.

    After Costa, Kantor & Choset, "Bearing-only landmark initialization with unknown data
    association", ICRA 2004, as summarized in Tacher §2, with the correlations that they neglect.
    Measurements of landmarks of the map correct it, within the gate, as in `EkfSlam`. One without
    a landmark in the map becomes a *stored measurement*, a variable of the state (`state` has a
    diagram). Then

    1. it confirms the *hypotheses* that agree with it: g² <= γ·var(g), g the difference between
       the measurement and its prediction from the point, with all correlations. Their persistence
       rises by 1, and they are corrected, but not the robot.
       Those of its tag that it does not confirm lose `decay`; at 0 they are deleted.
    2. if it confirms none it is intersected with older stored measurements. Well conditioned
       intersections become hypotheses of persistence 1, unless one exists at that position.
    3. a hypothesis of enough persistence becomes a landmark, estimated from up to eight of its
       stored measurements, the oldest and the newest, at once: they give its position and all its
       covariances, and the redundant ones correct the whole map (`initialization`). Then they are
       marginalized out. Promotion waits while the mirror solution fits nearly as well or the
       covariance is too large; the hypothesis is deleted where its measurements contradict each
       other.

    Errors are Euclidean and Jacobians are taken at the estimate: linearizers with memory and other
    charts are not defined for stored measurements.

    Two circles intersect in two points: both become hypotheses, of one group, and none is promoted
    before its persistence exceeds that of the other by `lead` and it fits its measurements clearly
    better than its mirror solution. So a range-only landmark needs a path that is not straight.

    Raises ValueError on a capacity below 1, a gate not above 0 and below 1, a part of another kind,
    or a sensor that does not fit.
    """

    motion: Motion
    sensor: Sensor
    """of one bearing or one range of points"""
    capacity: int = static()
    """landmarks N"""
    _: dataclasses.KW_ONLY
    triangulation: Triangulation | None = None
    """how stored measurements intersect; default the intersection of rays or of circles,
    by what the sensor measures"""
    stored: StoredMeasurements = StoredMeasurements()
    hypotheses: Hypotheses = Hypotheses()
    promotion: Promotion = Promotion()
    gate: Number | None = None
    """the probability that a correct comparison passes, by γ = χ²(1, gate); default 0.99"""
    associate: Associate = Known()
    """with `Known` only measurements of one tag intersect. With any other method, the measurements
    it declares new intersect all others, and tags only name the landmarks"""
    chart = Euclidean()

    def __post_init__(self) -> None:
        name, sensor = type(self).__name__, self.sensor
        validation.check_models(name, self.motion, sensor)
        validation.check_parts(name, associate=self.associate)
        hold_function(self, "associate", "prediction, scan")
        if len(sensor.measurements) != 1 or not sensor.of_points:
            raise ValueError(
                f"{name}: expected a sensor of one bearing or one range of points (x, y), got "
                f"{sensor.name} with {sensor.measurements} of {sensor.landmark}"
            )
        validation.check_count(f"{name}: capacity", self.capacity)
        validation.check_gate(name, self.gate)
        triangulation = self.triangulation or triangulation_of(sensor)
        set_field(self, "triangulation", triangulation)
        kinds = {
            "triangulation": Triangulation,
            "stored": StoredMeasurements,
            "hypotheses": Hypotheses,
            "promotion": Promotion,
        }
        for field, kind in kinds.items():
            validation.check_record(name, field, getattr(self, field), kind)
        if sensor.measurements != (triangulation.measurement,):
            raise ValueError(
                f"{name}: expected a sensor of one {triangulation.measurement}, got "
                f"{sensor.name} with {sensor.measurements}"
            )
        super().__post_init__()

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> DelayedState:
        return empty_state(self._settings.layout, pose, pose_cov)

    def predict(self, state: DelayedState, u: Float[Array, "U"], key: Array) -> DelayedState:
        return state._replace(joint=self._ekf.predict(state.joint, u, key))

    def update(self, state: DelayedState, scan: Scan, key: Array) -> tuple[DelayedState, Info]:
        settings = self._settings
        # Padding may hold any number, and is multiplied by zero below.
        scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
        state = state._replace(clock=state.clock + 1)
        sensor, ekf = settings.sensor, self._ekf
        # Hypotheses and stored measurements are not landmarks.
        is_landmark = jnp.arange(settings.layout.slots) < settings.layout.landmarks
        landmarks = state.joint._replace(alive=state.joint.alive & is_landmark)
        found, matched = associate_scan(
            self.associate, sensor, scan, lambda: prediction_of(ekf, sensor, landmarks)
        )
        slot = jnp.maximum(found.slot, 0)
        joint, correction = correct_in_turn(ekf, sensor, state.joint, scan.z, slot, matched)
        state = state._replace(joint=joint)
        new = _new_measurements(settings, scan, found)

        def initialize(state: DelayedState) -> tuple[DelayedState, _Outcome]:
            state, slot, stored = _store_measurements(settings, state, new)
            state, explained, by = confirm_hypotheses(settings, state, new, slot, stored)
            state = intersect_measurements(settings, state, new, slot, stored & ~explained)
            state, promoted = promote_hypotheses(settings, state, new, by)
            return state, _Outcome(stored, promoted)

        def leave(state: DelayedState) -> tuple[DelayedState, _Outcome]:
            return state, _Outcome(jnp.zeros_like(new.is_new), Promoted.none(new))

        steps = initialize if len(scan.tag) > 0 else leave
        state, outcome = where_any(new.wanted.any(), steps, leave, state)
        return state, _report(scan, found, matched, correction, new, outcome)

    def estimate(self, state: DelayedState) -> Estimate:
        joint, capacity, size = state.joint, self.capacity, 3 + SIZE * self.capacity
        landmarks = joint._replace(
            landmarks=joint.landmarks[:capacity],
            cov=joint.cov[:size, :size],
            alive=joint.alive[:capacity],
            tag=joint.tag[:capacity],
        )
        return estimate_of(landmarks, self._settings.sensor, self.chart)

    @property
    def _ekf(self) -> EkfSlam:
        """The EKF-SLAM by which landmarks of the map are associated and corrected."""
        gate = 0.99 if self.gate is None else self.gate
        return EkfSlam(self.motion, self.sensor, self.capacity, associate=self.associate, gate=gate)

    @property
    def _settings(self) -> DelayedSettings:
        capacities = self.hypotheses.capacity, self.stored.capacity
        gate = 0.99 if self.gate is None else self.gate
        assert self.triangulation is not None
        return DelayedSettings(
            sensor=on_ground(self.sensor, SIZE),
            triangulation=self.triangulation,
            layout=TableLayout(self.capacity, *capacities),
            associate=self.associate,
            by_tag=isinstance(self.associate, Known),
            gate=gate,
            gamma=chi2_quantile(gate, 1),
            stored=self.stored,
            hypotheses=self.hypotheses,
            promotion=self.promotion,
        )


class _Outcome(NamedTuple):
    """The outcome of the new measurements of a scan."""

    stored: Bool[Array, "M"]
    promoted: Promoted


def _new_measurements(settings: DelayedSettings, scan: Scan, found: Association) -> NewMeasurements:
    """The measurements of a scan that association declares new."""
    is_new = scan.valid & found.is_new
    if settings.by_tag:
        return NewMeasurements(
            scan.z, scan.tag, scan.tag, is_new, slots.seen_before(scan.tag, is_new)
        )
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
    """The `Info` of a scan: what became of each of its measurements."""
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
