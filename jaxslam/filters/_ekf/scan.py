"""The update of a `Joint` by a scan: each sensor corrects the map, then initializes landmarks.

The steps are those of the textbook, one function each: `associate_scan` predicts the measurements
and associates them, `update.correct` gates and corrects, `initialize_landmarks` starts the new
landmarks (the state augmentation), and `_report_scan` makes the `Info`.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.protocols import Association, LinearizationPoint, Sensor
from jaxslam.core.slots import Joint
from jaxslam.core.types import Info, Scan
from jaxslam.filters._ekf.ekf_settings import EkfSettings
from jaxslam.filters._ekf.innovation import Correction
from jaxslam.filters._ekf.linear_system import LinearLandmarks, LinearMeasurements, LinearSystem
from jaxslam.filters._ekf.predicted_measurements import prediction_of
from jaxslam.filters._ekf.update import correct, correct_in_turn
from jaxslam.filters._reporting import info_of, joined_info, nothing_of, seen_before, status_of
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import change_where, last_true_column, materialize, where_any
from jaxslam.sensors._suite import Part, Suite, on_ground, split_scan


def augment(
    joint: Joint,
    z: Float[Array, "m Z"],
    tag: Int[Array, "m"],
    slot: Int[Array, "m"],
    granted: Bool[Array, "m"],
    settings: EkfSettings,
) -> tuple[Joint, Float[Array, "m L 3"]]:
    """The joint with new landmarks of measurements z (m, Z) in free slots (m,), where granted (m,);
    and the derivatives G_R of their errors by that of the pose.

    L = g(R, z, s̄), P_LL = G_R P_RR G_Rᵀ + G_z R G_zᵀ + G_s S G_sᵀ, P_Lx = G_R P_Rx: Solà (32)-(38),
    with the prior's term of (44); several in one scan are correlated through the robot.
    """
    chart, square_root = settings.chart, settings.square_root
    point = LinearizationPoint(joint, chart, joint.pose, slots.robot_cov(joint, square_root))

    def one(
        z_i: Float[Array, "Z"], tag_i: Int[Array, ""]
    ) -> tuple[Float[Array, "L"], Float[Array, "L 3"], Float[Array, "L L"]]:
        landmark, by_pose, landmark_cov = settings.linearize.invert(
            settings.sensor, z_i, tag_i, point
        )
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            by_pose = by_pose @ basis.pose - basis.cross
            if basis.landmark is not None:
                undo = linalg.inverse(basis.landmark)
                by_pose, landmark_cov = undo @ by_pose, undo @ landmark_cov @ undo.T
        return landmark, by_pose, landmark_cov

    landmark, by_pose, landmark_covs = materialize(jax.vmap(one)(z, tag))
    joint = slots.scatter(
        joint, slot, granted, landmark, by_pose, landmark_covs, tag, square_root=square_root
    )
    new = jnp.zeros_like(joint.alive).at[slot].max(granted)
    return joint._replace(lin=settings.linearize.born(joint, new)), by_pose


class SensorStage(NamedTuple):
    """The measurement slots and settings of one sensor in a scan."""

    places: int | None
    """the measurement slots of this sensor in the scan; None for all"""
    settings: EkfSettings | None
    """None where its measurements are ignored: `Status.UNMATCHED`"""


class _NewLandmarks(NamedTuple):
    """The outcome of the measurements without a landmark in the map, (M,) each."""

    slot: Int[Array, "M"]
    granted: Bool[Array, "M"]
    deferred: Bool[Array, "M"]
    repeated: Bool[Array, "M"]
    evicted: Bool[Array, "N"]
    """slots that were emptied to make room"""
    by_pose: Float[Array, "M L 3"]
    """derivatives of the errors of those granted, by that of the pose"""


class _ScanUpdate(NamedTuple):
    """The result of an update by a scan."""

    joint: Joint
    info: Info
    evicted: Bool[Array, "N"]
    """slots that were emptied to make room"""
    system: LinearSystem


def stages_of(sensor: Sensor, settings: EkfSettings) -> list[SensorStage]:
    """The stages of the sensors of a suite, in order; a single stage for another sensor.

    Measurements of robots are ignored.
    """
    if not isinstance(sensor, Suite):
        return [SensorStage(None, dataclasses.replace(settings, absolute=not sensor.landmark))]
    return [
        SensorStage(part.places, None)
        if part.sees == "robots"
        else stage_of(part, len(sensor.landmark), settings)
        for part in sensor.parts
    ]


def stage_of(part: Part, size: int, settings: EkfSettings) -> SensorStage:
    """The part of a scan's update that is one sensor's, for landmarks of `size` numbers."""
    sensor = on_ground(part.sensor, size)
    return SensorStage(
        part.places, dataclasses.replace(settings, sensor=sensor, absolute=part.absolute)
    )


def update_by_scan(joint: Joint, scan: Scan, stages: Sequence[SensorStage]) -> _ScanUpdate:
    """The update by each sensor in turn.

    Raises ValueError if the scan does not have their measurement slots.
    """
    first = stages[0]
    if first.places is None and first.settings is not None:
        return _update_by_sensor(joint, scan, first.settings)
    system: LinearSystem = ()
    infos, evicted = [], jnp.zeros_like(joint.alive)
    counts = [stage.places or 0 for stage in stages]
    for part, stage in zip(split_scan(scan, counts), stages, strict=True):
        if stage.settings is None:
            infos.append(nothing_of(part))
            continue
        part = part._replace(z=part.z[:, : len(stage.settings.sensor.measurements)])
        joint, info, gone, more = _update_by_sensor(joint, part, stage.settings)
        infos.append(info)
        evicted, system = evicted | gone, (*system, *more)
    return _ScanUpdate(joint, joined_info(infos, scan.z.shape[1]), evicted, system)


def _update_by_sensor(joint: Joint, scan: Scan, settings: EkfSettings) -> _ScanUpdate:
    """The update by the scan of one sensor."""
    # Padding may hold any number, and is multiplied by zero below.
    scan = scan._replace(z=jnp.where(scan.valid[:, None], scan.z, 0.0))
    found, matched = associate_scan(joint, scan, settings)
    at_once = settings.correction == "joint" and len(scan.tag) > 0
    by_scan = correct if at_once else correct_in_turn
    slot = jnp.maximum(found.slot, 0)
    joint, correction = by_scan(joint, scan.z, slot, matched, settings)
    joint, new = initialize_landmarks(joint, scan, found, matched, correction, settings)
    info = _report_scan(scan, found, matched, correction, new, settings)
    fused = matched & correction.inside & correction.positive
    seen = LinearMeasurements(
        jacobian=correction.jacobian,
        basis=correction.basis,
        noise=jax.vmap(partial(predicted_noise, settings.sensor))(correction.z_hat, scan.z, fused),
        slot=slot,
        fused=fused,
    )
    born = LinearLandmarks(new.slot, new.granted, new.by_pose)
    return _ScanUpdate(joint, info, new.evicted, (seen, born))


def associate_scan(
    joint: Joint, scan: Scan, settings: EkfSettings
) -> tuple[Association, Bool[Array, "M"]]:
    """The association of a scan, and which measurements correct the map.

    Measurements of an absolute sensor have no landmark, and all valid ones correct.
    """
    if settings.absolute:
        none = jnp.full_like(scan.tag, -1)
        return Association(none, jnp.zeros_like(scan.valid), jnp.asarray(False)), scan.valid
    found = Association(*settings.associate(prediction_of(joint, settings), scan))
    matched = scan.valid & (found.slot >= 0) & ~found.is_new
    return found._replace(is_new=scan.valid & found.is_new), matched


def initialize_landmarks(
    joint: Joint,
    scan: Scan,
    found: Association,
    matched: Bool[Array, "M"],
    correction: Correction,
    settings: EkfSettings,
) -> tuple[Joint, _NewLandmarks]:
    """The map with the new landmarks of a scan, up to `births` and the free slots.

    matched, done: the measurements of known landmarks, and their correction; landmarks that were
    corrected do not make room for new ones.
    """
    is_new, none = found.is_new, jnp.zeros_like(found.is_new)
    nothing = _NewLandmarks(
        slot=jnp.zeros_like(found.slot),
        granted=none,
        deferred=none,
        repeated=none,
        evicted=jnp.zeros_like(joint.alive),
        by_pose=jnp.zeros((len(none), joint.landmarks.shape[1], 3), joint.pose.dtype),
    )
    if settings.births == 0:
        return joint, nothing._replace(deferred=is_new)

    def start(joint: Joint) -> tuple[Joint, _NewLandmarks]:
        repeated = is_new & seen_before(scan.tag, is_new)
        wanted = is_new & ~repeated
        rank = jnp.cumsum(wanted)
        deferred = jnp.zeros_like(wanted)
        if settings.births is not None:
            deferred = wanted & (rank > settings.births)
        wanted = wanted & ~deferred
        used = matched & correction.inside & correction.positive
        joint, evicted = _with_room(joint, wanted, found.slot, used, settings)
        joint, slot, granted, by_pose = _new_landmarks(joint, scan, wanted, rank, settings)
        return joint, _NewLandmarks(slot, granted, deferred, repeated, evicted, by_pose)

    return where_any(is_new.any(), start, lambda joint: (joint, nothing), joint)


def _with_room(
    joint: Joint,
    wanted: Bool[Array, "M"],
    slot: Int[Array, "M"],
    used: Bool[Array, "M"],
    settings: EkfSettings,
) -> tuple[Joint, Bool[Array, "N"]]:
    """The map without the landmarks that `Life.make_room` removes for new ones, and which."""
    if settings.life is None or settings.life.make_room is None:
        return joint, jnp.zeros_like(joint.alive)
    needed = wanted.sum() - (~joint.alive).sum()
    measured = slots.slot_mask(slot, used, len(joint.alive))
    evicted = settings.life.make_room(joint, needed, measured)
    return without_landmarks(joint, evicted, square_root=settings.square_root), evicted


def _new_landmarks(
    joint: Joint,
    scan: Scan,
    wanted: Bool[Array, "M"],
    rank: Int[Array, "M"],
    settings: EkfSettings,
) -> tuple[Joint, Int[Array, "M"], Bool[Array, "M"], Float[Array, "M L 3"]]:
    """The map with landmarks started in free slots; slot, granted and by_pose of `_NewLandmarks`.

    rank: (M,) the number wanted up to each measurement.
    """
    births = settings.births
    taken = joint.alive if settings.reserved is None else joint.alive | settings.reserved
    if births is None or births >= len(wanted):
        slot, granted = slots.allocate(taken, wanted)
        joint, by_pose = augment(joint, scan.z, scan.tag, slot, granted, settings)
        return joint, slot, granted, by_pose
    # No more than may be granted are computed.
    is_kth = wanted[None, :] & (rank[None, :] == 1 + jnp.arange(births)[:, None])
    at, has_slot = last_true_column(is_kth)
    slot, granted = slots.allocate(taken, has_slot)
    joint, by_pose = augment(joint, scan.z[at], scan.tag[at], slot, granted, settings)
    mine = jnp.clip(rank - 1, 0, births - 1)
    return joint, slot[mine], wanted & granted[mine], by_pose[mine]


def _report_scan(
    scan: Scan,
    found: Association,
    matched: Bool[Array, "M"],
    correction: Correction,
    new: _NewLandmarks,
    settings: EkfSettings,
) -> Info:
    """The `Info` of the measurements of one sensor."""
    status = status_of(
        scan.valid,
        matched=matched,
        positive=correction.positive,
        inside=correction.inside,
        new=found.is_new,
        repeated=new.repeated,
        granted=new.granted,
        deferred=new.deferred,
    )
    return info_of(
        status,
        matched,
        size=len(settings.sensor.measurements),
        slot=found.slot,
        born=new.slot,
        nis=correction.nis,
        innovation=correction.innovation,
        innovation_cov=correction.innovation_cov,
        log_likelihood=correction.log_likelihood.sum(),
        exhausted=jnp.asarray(found.exhausted),
    )


def without_landmarks(joint: Joint, dead: Bool[Array, "N"], *, square_root: bool = False) -> Joint:
    """The map without the landmarks of the slots `dead`; without such a slot unchanged to the bit.

    A root is made triangular again; a run without a removal keeps its root to the bit.
    """
    remove = partial(slots.remove, dead=dead, square_root=square_root)
    return change_where(dead.any(), remove, joint)
