"""EKF-SLAM in the order of Solà's guide; the published variants are fields of one filter.

A step predicts, `propagate` (14)-(17), and updates by each sensor of the robot in turn,
`update_by_sensors`: associate, correct (`correction`, (26)-(30)), initialize (31)-(38), report.
Beside this file, the plain filter needs `correction` and `whitening`; `linear_system` is for charts
and the observability monitor, `map_coordinates` for charts and inverse depths,
`predicted_measurements` for associations that compare a measurement with every landmark.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean, with_further
from jaxslam.core import slots
from jaxslam.core._numbers import gate_quantile
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import (
    Associate,
    Association,
    Chart,
    Filter,
    Life,
    LinearizationPoint,
    Linearizer,
    Motion,
    Prediction,
    Sensor,
)
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.core.validation import at_least, instance_of, one_of, or_none, probability
from jaxslam.filters._ekf import map_coordinates
from jaxslam.filters._ekf.checks import check_fit
from jaxslam.filters._ekf.correction import CorrectionOrder, Covariance, correct, correct_in_turn
from jaxslam.filters._ekf.linear_system import (
    LinearizedSteps,
    LinearLandmarks,
    LinearMeasurements,
    LinearSystem,
    Transition,
    landmark_errors_in_chart,
    moved_cov,
    transition_in_chart,
)
from jaxslam.filters._ekf.predicted_measurements import prediction_of
from jaxslam.filters._reporting import (
    NewLandmarks,
    info_of_ignored,
    join_infos,
    report_scan,
    with_extra,
    with_removed,
)
from jaxslam.linearize._first_order import AtEstimate, predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._xla import change_where, last_true_column, materialize, where_any
from jaxslam.sensors._suite import of_robot


@record
class EkfSlam(Filter):
    """Extended Kalman filter SLAM in a map of fixed capacity (Solà 2).

    Each step propagates the robot (14)-(17); each scan corrects (26)-(30), then starts its new
    landmarks (31)-(38). The state is a `slots.Joint`; `slots.remove` deletes landmarks from it.

    Every valid measurement of an absolute sensor (L = 0: compass, position fix) corrects the robot,
    whatever its tag, and has slot -1; `associate` and `births` do not apply, and the map is empty.

    The E further numbers of `Motion.state` follow the pose in P, R = 3 + E rows of the robot; their
    errors are differences, in every chart.

    Several sensors are one `sensors.Suite`, whose parts are processed one after the other.

    Raises ValueError on models, charts, linearizers or associations of another type or size
    (`validation`), a capacity, iterations or births below 1, a gate not above 0 and below 1, an
    unknown correction or covariance, a chart or linearizer that does not fit the sensor's landmarks
    or one another, several iterations of a statistical linearizer, or a linearizer of landmarks for
    a suite with an absolute sensor.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    """the models; Jacobians come from `jax.jacfwd`"""
    capacity: int = static(check=at_least(1))
    """landmark slots N. A new landmark that finds the map full is dropped and marked
    `Status.OVERFLOW`"""
    _: dataclasses.KW_ONLY
    chart: Chart = field(default=Euclidean(), check=instance_of(Chart))
    """the error coordinates of P"""
    linearize: Linearizer = field(default=AtEstimate(), check=instance_of(Linearizer))
    """where Jacobians are taken"""
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """the landmark of each measurement"""
    correction: CorrectionOrder = static(
        default="sequential", check=one_of(*get_args(CorrectionOrder))
    )
    """"sequential" corrects by one measurement after the other, relinearizing each time, as the
    guide does; "joint" corrects by the whole scan at once"""
    gate: Number | None = field(default=None, check=or_none(probability))
    """the probability that a correct measurement passes, above 0 and below 1, as 0.999: one whose
    squared Mahalanobis distance d² exceeds the χ² quantile of its Z numbers is rejected; None: none
    is. The guide's 3 σ is `stats.sigma_gate(3, 2)`. float32 has no number between 1 - 6e-8
    (d² = 33 of Z = 2) and 1"""
    iterations: int = static(default=1, check=at_least(1))
    """passes of the iterated EKF, each from the same prior; 1 is the plain EKF"""
    covariance: Covariance = static(default="plain", check=one_of(*get_args(Covariance)))
    """"plain"; "joseph", Joseph's form of the update, which costs more, and in float32 fails where
    "plain" does; or "square_root", a root X of P = X Xᵀ instead of P, which holds twice the digits,
    at a higher cost (the prediction is O(N³))"""
    births: int | None = static(default=None, check=or_none(at_least(1)))
    """largest number of new landmarks a scan, the first in its order (that of tags in simulated
    scans), the rest `Status.DEFERRED`. The guide starts one, picked at random. None: no limit"""
    life: Life | None = field(default=None, check=or_none(instance_of(Life)))
    """a rule that removes landmarks after each scan, and may make room in a full map. Its memory is
    `Joint.life`; `info.extra["pruning"].removed` (N,) bool marks the slots"""
    further = True

    def __post_init__(self) -> None:
        check_fit(self.sensor, self.chart, self.linearize, self.iterations)
        super().__post_init__()

    @property
    def square_root(self) -> bool:  # type: ignore[override]
        return self.covariance == "square_root"

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.landmark

    @property
    def robot_chart(self) -> Chart:
        """The chart of all R numbers of the robot."""
        return with_further(self.chart, self.motion.state)

    @property
    def linearized(self) -> LinearizedSteps | None:
        """The steps with their linear system; None of a class that overrides one."""
        plain = type(self).predict is EkfSlam.predict and type(self).update is EkfSlam.update
        if not plain:
            return None
        return LinearizedSteps(
            lambda state, u, _: propagate(self, state, u),
            lambda state, scan, _: update_by_sensors(self, state, scan),
        )

    def init(self, pose: Float[Array, "R"], pose_cov: Float[Array, "R R"]) -> Joint:
        chart, size_l = self.robot_chart, len(self.sensor.landmark)
        if chart.basis is not None:
            # E⁻¹ P E⁻ᵀ: `pose_cov` is of coordinates, P is of the errors in the chart.
            to_errors = linalg.inverse(chart.pose_basis(pose))
            pose_cov = to_errors @ pose_cov @ to_errors.T
        no_landmarks = jnp.zeros((self.capacity, size_l), pose.dtype)
        memory = self.linearize.init(pose, no_landmarks)
        joint = slots.empty(
            pose, pose_cov, self.capacity, size_l, memory, square_root=self.square_root
        )
        if self.sensor.reduced is not None:
            joint = joint._replace(reduced=jnp.zeros_like(joint.alive))
        if self.life is not None:
            joint = joint._replace(life=self.life.init(joint.pose, joint.landmarks))
        return joint

    def predict(self, state: Joint, u: Float[Array, "U"], key: Array) -> Joint:
        return propagate(self, state, u)[0]

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return update_by_sensors(self, state, scan)[:2]

    def estimate(self, state: Joint) -> Estimate:
        return map_coordinates.estimate_of(
            state, self.sensor, self.robot_chart, square_root=self.square_root
        )


def propagate(filter: EkfSlam, joint: Joint, u: Float[Array, "U"]) -> tuple[Joint, LinearSystem]:
    """The state after the robot's motion, and the transition of its errors: Solà (14)-(17).

    R ← f(R, u, 0), P_RR ← F P_RR Fᵀ + N, N = W Q Wᵀ, P_RM ← F P_RM; O(N). In another chart the
    errors of the landmarks change too (`moved_cov`, O(N²)). A square root X of P = X Xᵀ becomes the
    triangular root of [A X, G √N], O(N³).
    """
    chart, n = filter.robot_chart, joint.robot_size
    point = LinearizationPoint(
        joint, chart, joint.robot, slots.robot_cov(joint, filter.square_root)
    )
    # (14) is the mean; by_pose = F and noise = W Q Wᵀ are the Jacobian and the noise of (15).
    pose, by_pose, noise, memory = filter.linearize.motion(filter.motion, u, point)
    if chart.basis is None:
        # dx ← F dx + noise; the errors of the landmarks stay.
        unit = jnp.eye(n, dtype=noise.dtype)
        transition = Transition(
            robot=by_pose, cross=None, landmark=None, noise=unit, cross_noise=None
        )
    else:
        # Stored: each landmark's block of the transition needs it.
        pose = materialize(pose)
        transition = transition_in_chart(chart, by_pose, joint, pose)
    if filter.square_root:
        # Wide root [A X, G √N], (D, D + R); reflections from the right make it (D, D) again.
        added = transition.lift(len(joint.cov)) @ linalg.cholesky(noise)[0]
        root = jnp.concatenate([transition.times(joint.cov), added], axis=1)
        cov = linalg.triangular_root(root)
    elif chart.basis is None:
        # (15), (16): the R rows of the robot alone, O(N); P of the map stays as it is.
        robot_rows = linalg.matmul(by_pose, joint.cov[:n])
        robot_cov = linalg.symmetrize(linalg.matmul(robot_rows[:, :n], by_pose.T) + noise)
        # Stored separately from P, from which it is computed, so that P is written in place.
        rows = materialize(jnp.concatenate([robot_cov, robot_rows[:, n:]], axis=1))
        # (17): the columns are the same numbers, so P stays symmetric to the bit.
        cov = jnp.asarray(joint.cov).at[:n].set(rows).at[:, :n].set(rows.T)
    else:
        cov = moved_cov(joint.cov, transition, noise)
    return joint.with_robot(pose)._replace(cov=cov, lin=memory), (transition,)


def update_by_sensors(
    filter: EkfSlam,
    joint: Joint,
    scan: Scan,
    parts: Sequence[tuple[Sensor | None, Scan, int | None]] | None = None,
    reserved: Bool[Array, "N"] | None = None,
) -> tuple[Joint, Info, LinearSystem]:
    """The update by each sensor in turn: associate, correct, initialize, report.

    Then landmarks are removed by `EkfSlam.life`. Returns also the linear system, for the monitor.

    parts: the sensors, each with its scan and the births allowed to it; default those of
    `EkfSlam.sensor`. reserved: slots that no new landmark may take, as the poses of `TeamSlam`.
    """
    if parts is None:
        parts = [(sensor, part, filter.births) for sensor, part in filter.sensor.scans(scan)]
    infos, evicted = [], jnp.zeros_like(joint.alive)
    system: LinearSystem = ()
    for sensor, part, births in parts:
        if sensor is None:  # of a suite: it measures other robots, as `TeamSlam` uses
            infos.append(info_of_ignored(part))
            continue
        sensor = of_robot(sensor, filter.motion.state)
        # Padding may hold any number, and is multiplied by zero below.
        part = part._replace(z=jnp.where(part.valid[:, None], part.z, 0.0))
        # Associate: the landmark of each measurement. The prediction is made only if it is used.
        association, matched = associate_scan(
            filter.associate, sensor, part, partial(prediction_of, filter, sensor, joint)
        )
        # Correct: (26)-(30).
        # -1, for no slot, becomes index 0; what is read there is masked by `matched`.
        slot = jnp.maximum(association.slot, 0)
        # A scan without slots has no S to factor; in turn, it is a loop of no passes.
        by_scan = filter.correction == "joint" and len(part.tag) > 0
        gamma = gate_quantile(filter.gate, len(sensor.measurements))
        correct_by = correct if by_scan else correct_in_turn
        joint, correction = correct_by(filter, sensor, joint, part.z, slot, matched, gamma)
        # Measurements outside the gate or with a singular S had no effect in the correction.
        fused = matched & correction.inside & correction.positive
        # Initialize: (31)-(38), from the corrected pose, as in the guide.
        measured = slots.slot_mask(association.slot, fused, len(joint.alive))
        joint, new, removed, by_pose = initialize(
            filter, sensor, joint, part, association.is_new, measured, births, reserved
        )
        evicted = evicted | removed
        # Report: a `Status` for every measurement.
        infos.append(report_scan(part.valid, association, matched, correction, new))
        # For the monitor; without it, `jit` drops these lines.
        noise = jax.vmap(partial(predicted_noise, sensor))(correction.z_hat, part.z, fused)
        system = (
            *system,
            LinearMeasurements(correction.jacobian, correction.basis, noise, slot, fused),
            LinearLandmarks(new.slot, new.granted, by_pose),
        )
    info = join_infos(infos, scan.z.shape[1])
    if filter.sensor.reduced is not None:
        # An inverse depth that has become certain enough is a point from now on.
        joint, is_reduced, reduction = map_coordinates.reduce_where_ready(
            joint, filter.sensor, filter.square_root
        )
        info = with_extra(info, "points", map_coordinates.ToPoints(is_reduced))
        system = (*system, reduction)
    # After the corrections: whether a landmark lives on depends on what this scan measured.
    if filter.life is not None:
        memory, dead = filter.life.after(joint, info, partial(filter.estimate, joint))
        joint = without_landmarks(filter, joint._replace(life=memory), dead)
        info = with_removed(info, evicted | dead)
    return joint, info, system


def associate_scan(
    associate: Associate, sensor: Sensor, scan: Scan, prediction: Callable[[], Prediction]
) -> tuple[Association, Bool[Array, "M"]]:
    """The association of a scan, and which measurements correct the state.

    Measurements of an absolute sensor have no landmark, and all valid ones correct; then
    prediction() is not called.
    """
    if sensor.absolute:
        no_slot = jnp.full_like(scan.tag, -1)
        return Association(no_slot, jnp.zeros_like(scan.valid), jnp.asarray(False)), scan.valid
    # A user's method may return a plain tuple.
    association = Association(*associate(prediction(), scan))
    matched = scan.valid & (association.slot >= 0) & ~association.is_new
    return association._replace(is_new=scan.valid & association.is_new), matched


_Initialized = tuple[Joint, NewLandmarks, Bool[Array, "N"], Float[Array, "M L R"]]


def initialize(
    filter: EkfSlam,
    sensor: Sensor,
    joint: Joint,
    scan: Scan,
    is_new: Bool[Array, "M"],
    measured: Bool[Array, "N"],
    births: int | None,
    reserved: Bool[Array, "N"] | None,
) -> _Initialized:
    """The map with the new landmarks of a scan, up to `births` and the free slots: Solà (31)-(38).

    L = g(R, z, s̄), P_LL = G_R P_RR G_Rᵀ + G_z R G_zᵀ + G_s S G_sᵀ, P_Lx = G_R P_Rx, with the
    prior's term of (44); several in one scan are correlated through the robot.

    measured: landmarks that the scan corrected, which do not make room for new ones. Returns also
    the slots (N,) that were emptied to make room, and G_R (M, L, R) of the new landmarks.
    """
    chart, m = filter.robot_chart, len(is_new)
    no_jacobian = jnp.zeros((m, joint.landmarks.shape[1], joint.robot_size), joint.pose.dtype)
    no, none_evicted = jnp.zeros_like(is_new), jnp.zeros_like(joint.alive)
    no_landmark = NewLandmarks(jnp.zeros(m, jnp.int32), no, no, no)
    if births == 0:
        return joint, no_landmark._replace(deferred=is_new), none_evicted, no_jacobian

    def invert(
        point: LinearizationPoint, z: Float[Array, "Z"], tag: Int[Array, ""]
    ) -> tuple[Float[Array, "L"], Float[Array, "L R"], Float[Array, "L L"]]:
        # (32); G_R of (33); and what (44) adds to G_R P_RR G_Rᵀ, by the noises of z and s.
        landmark, by_pose, cov = filter.linearize.invert(sensor, z, tag, point)
        return landmark, *landmark_errors_in_chart(chart, point.pose, landmark, by_pose, cov)

    def start(joint: Joint) -> _Initialized:
        # Each measurement of `is_new` is repeated, deferred, granted, or finds the map full.
        repeated = is_new & slots.seen_before(scan.tag, is_new)
        wanted = is_new & ~repeated
        # The rank counts from 1, and is constant over the measurements that are not wanted.
        rank = jnp.cumsum(wanted)
        deferred = no if births is None else wanted & (rank > births)
        wanted = wanted & ~deferred
        evicted = none_evicted
        if filter.life is not None and filter.life.make_room is not None:
            needed = wanted.sum() - (~joint.alive).sum()
            # Not above 0 while there are free slots enough: then nothing is evicted.
            evicted = filter.life.make_room(joint, needed, measured)
            joint = without_landmarks(filter, joint, evicted)
        occupied = joint.alive if reserved is None else joint.alive | reserved
        z, tag, candidate, limit = scan.z, scan.tag, wanted, m if births is None else births
        if limit < m:  # only as many landmarks are computed as may start
            is_kth = wanted[None, :] & (rank[None, :] == 1 + jnp.arange(limit)[:, None])
            # The measurement (limit,) of each birth, where there are so many.
            source, candidate = last_true_column(is_kth)
            z, tag = z[source], tag[source]
        slot, granted = slots.allocate(occupied, candidate)
        robot_cov = slots.robot_cov(joint, filter.square_root)
        point = LinearizationPoint(joint, chart, joint.robot, robot_cov)
        landmark, by_pose, own_cov = jax.vmap(partial(invert, point))(z, tag)
        # (35)-(38): P_LL and P_Lx into rows and columns of padding, whose size does not change.
        joint = slots.scatter(
            joint, slot, granted, landmark, by_pose, own_cov, tag, square_root=filter.square_root
        )
        # max, since a measurement without a slot has index 0, which may be another's slot.
        entered = jnp.zeros_like(joint.alive).at[slot].max(granted)
        joint = joint._replace(lin=filter.linearize.remember(joint, entered))
        if limit < m:  # back from the births (k) to the measurements (M)
            k = jnp.clip(rank - 1, 0, limit - 1)
            slot, granted, by_pose = slot[k], wanted & granted[k], by_pose[k]
        return joint, NewLandmarks(slot, granted, deferred, repeated), evicted, by_pose

    def start_none(joint: Joint) -> _Initialized:
        return joint, no_landmark, none_evicted, no_jacobian

    return where_any(is_new.any(), start, start_none, joint)


def without_landmarks(filter: EkfSlam, joint: Joint, dead: Bool[Array, "N"]) -> Joint:
    """The map without the landmarks of the slots `dead`; without such a slot unchanged to the bit.

    A root is made triangular again; a run without a removal keeps its root to the bit.
    """
    remove = partial(slots.remove, dead=dead, square_root=filter.square_root)
    return change_where(dead.any(), remove, joint)
