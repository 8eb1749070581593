"""EKF-SLAM with delayed initialization of landmarks, from intersections of measurements."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core._numbers import gate_quantile
from jaxslam.core._record import record
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.filters._delayed.confirmation import confirm_hypotheses
from jaxslam.filters._delayed.delayed_filter import DelayedFilter
from jaxslam.filters._delayed.intersection import intersect_measurements
from jaxslam.filters._delayed.promotion import Promoted, promote_hypotheses
from jaxslam.filters._delayed.state import (
    SIZE,
    DelayedState,
    NewMeasurements,
    add_to,
    delete_slots_if_any,
    empty_state,
    is_newer,
    slots_where,
)
from jaxslam.filters._ekf.correction import correct_in_turn
from jaxslam.filters._ekf.ekf_slam import EkfSlam, associate_scan
from jaxslam.filters._ekf.map_coordinates import estimate_of
from jaxslam.filters._ekf.predicted_measurements import prediction_of
from jaxslam.filters._reporting import NewLandmarks, report_scan
from jaxslam.math._xla import where_any


@record
class DelayedSlam(DelayedFilter):
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

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> DelayedState:
        return empty_state(self.layout, pose, pose_cov)

    def predict(self, state: DelayedState, u: Float[Array, "U"], key: Array) -> DelayedState:
        return state._replace(joint=self._ekf.predict(state.joint, u, key))

    def update(self, state: DelayedState, scan: Scan, key: Array) -> tuple[DelayedState, Info]:
        # Padding may hold any number, and is multiplied by zero below.
        scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
        state = state._replace(clock=state.clock + 1)
        ekf, sensor = self._ekf, self.sensor_of_table
        # Associate with the landmarks of the map; hypotheses and stored measurements are none.
        is_landmark = jnp.arange(self.layout.slots) < self.capacity
        landmarks = state.joint._replace(alive=state.joint.alive & is_landmark)
        association, matched = associate_scan(
            self.associate, sensor, scan, lambda: prediction_of(ekf, sensor, landmarks)
        )
        # Correct, as EKF-SLAM does.
        slot = jnp.maximum(association.slot, 0)
        joint, correction = correct_in_turn(
            ekf, sensor, state.joint, scan.z, slot, matched, gate_quantile(ekf.gate, 1)
        )
        state = state._replace(joint=joint)
        # Initialize: store, confirm, intersect, promote.
        is_new, tag = association.is_new, scan.tag
        repeated = slots.seen_before(tag, is_new) if self.by_tag else jnp.zeros_like(is_new)
        identity = tag if self.by_tag else jnp.full_like(tag, -1)
        new = NewMeasurements(scan.z, identity, tag, is_new, repeated)

        def initialize(
            state: DelayedState,
        ) -> tuple[DelayedState, tuple[Bool[Array, "M"], Promoted]]:
            # Only a measurement that no hypothesis explains may form one.
            state, slot, stored = _store_measurements(self, state, new)
            state, explained, confirmed_by = confirm_hypotheses(self, state, new, slot, stored)
            state = intersect_measurements(self, state, new, slot, stored & ~explained)
            state, promoted = promote_hypotheses(self, state, new, confirmed_by)
            return state, (stored, promoted)

        def leave(state: DelayedState) -> tuple[DelayedState, tuple[Bool[Array, "M"], Promoted]]:
            return state, (jnp.zeros_like(new.is_new), Promoted.none(new))

        # The steps take an argmin over the measurements, of which there must be one.
        steps = initialize if len(scan.tag) > 0 else leave
        state, (stored, promoted) = where_any(new.wanted.any(), steps, leave, state)
        outcome = NewLandmarks(
            slot=promoted.slot,
            granted=promoted.slot >= 0,
            deferred=new.wanted & ~stored & ~promoted.refused,
            repeated=new.repeated,
            stored=stored & ~promoted.refused,
        )
        return state, report_scan(scan.valid, association, matched, correction, outcome)

    def estimate(self, state: DelayedState) -> Estimate:
        joint, capacity, size = state.joint, self.capacity, 3 + SIZE * self.capacity
        # Landmarks are the first slots of the table, so their P is its leading block.
        landmarks = joint._replace(
            landmarks=joint.landmarks[:capacity],
            cov=joint.cov[:size, :size],
            alive=joint.alive[:capacity],
            tag=joint.tag[:capacity],
        )
        return estimate_of(landmarks, self.sensor_of_table, self.chart)

    @property
    def _ekf(self) -> EkfSlam:
        """The EKF-SLAM by which landmarks of the map are associated and corrected."""
        return EkfSlam(
            self.motion,
            self.sensor,
            self.capacity,
            associate=self.associate,
            gate=self.probability,
        )


def _store_measurements(
    filter: DelayedFilter, state: DelayedState, new: NewMeasurements
) -> tuple[DelayedState, Int[Array, "M"], Bool[Array, "M"]]:
    """The state with new measurements stored, their slots, and the mask of those stored.

    A measurement is stored if the sensor is far enough from its positions at the stored
    measurements of the same tag. In a full table the oldest are marginalized out.
    """
    layout, joint = filter.layout, state.joint
    store = partial(filter.triangulation.store, filter.sensor_of_table)
    values = jax.vmap(store, (None, 0))(joint.pose, new.z)
    by_pose, by_z = jax.vmap(jax.jacfwd(store, argnums=(0, 1)), (None, 0))(joint.pose, new.z)
    alive, tag = joint.alive[layout.of_stored], joint.tag[layout.of_stored]
    offset = values[:, None, :2] - joint.landmarks[None, layout.of_stored, :2]
    close = ((offset**2).sum(axis=2) < filter.stored.spacing**2) & alive[None]
    wanted = new.wanted & ~(close & (new.tag[:, None] == tag[None])).any(axis=1)

    needed = wanted.sum() - (~alive).sum()
    # The sum of a column of `is_newer` is the rank from the oldest; a free slot counts as newest.
    age = jnp.where(alive, state.taken_at, state.clock + 1)
    evicted = alive & (is_newer(age).sum(axis=0) < needed)
    state = delete_slots_if_any(layout, state, slots_where(layout, stored=evicted))

    joint = state.joint
    place, stored = slots.allocate(joint.alive[layout.of_stored], wanted)
    # R at z, as there is no prediction; with a hypothesis there is one (`StoredNoise`).
    noise_cov = jax.vmap(filter.sensor_of_table.noise_cov)(new.z)
    stored_cov = jnp.einsum("mij,mjk,mlk->mil", by_z, noise_cov, by_z)
    slot = layout.first_stored + place
    joint = slots.scatter(joint, slot, stored, values, by_pose, stored_cov, new.tag)
    at = jnp.where(stored, place, layout.stored)  # beyond the end: dropped
    state = state._replace(
        joint=joint,
        taken_at=state.taken_at.at[at].set(state.clock, mode="drop"),
        z=state.z.at[at].set(new.z, mode="drop"),
        by_z=state.by_z.at[at].set(by_z[:, 2, 0], mode="drop"),
        counts=state.counts._replace(evicted=add_to(state.counts.evicted, evicted)),
    )
    return state, slot, stored
