"""EKF-SLAM: the one Kalman-type SLAM filter, of which the published variants are arguments."""

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import linalg, slots
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters import augmentation, correction, propagation
from jaxslam.filters.expectation import prediction_of
from jaxslam.linalg import check_count, is_concrete
from jaxslam.linearize.at_estimate import at_estimate
from jaxslam.protocols import (
    Associate,
    Association,
    Chart,
    Filter,
    Life,
    Linearizer,
    Motion,
    Sensor,
)
from jaxslam.slots import Joint
from jaxslam.staging import where_any
from jaxslam.types import Estimate, Info, Scan, Status


class Births(NamedTuple):
    """What became of the measurements of a scan that are of no landmark of the map, (M,) each."""

    slot: jax.Array
    granted: jax.Array
    deferred: jax.Array
    repeated: jax.Array
    given_up: jax.Array
    """(N,) slots that were emptied to make room"""


def ekf_slam(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    chart: Chart | None = None,
    linearize: Linearizer | None = None,
    associate: Associate | None = None,
    update: Literal["sequential", "joint"] = "sequential",
    gate: float | None = None,
    iterations: int = 1,
    joseph: bool = False,
    births: int | None = None,
    square_root: bool = False,
    watch: bool = False,
    life: Life | None = None,
) -> Filter:
    """Extended Kalman filter SLAM in a map of fixed capacity (Solà 2).

    Each step propagates the robot (14)-(17); each scan corrects (26)-(30), then starts its new
    landmarks (31)-(38). The state is a `slots.Joint`; `slots.remove` deletes landmarks from it.

    Every valid measurement of an absolute sensor (L = 0: compass, position fix) corrects the robot,
    whatever its tag, and has slot -1; `associate` and `births` do not apply, and the map is empty.

    Args:
        motion, sensor: the models; Jacobians come from `jax.jacfwd`.
        capacity: landmark slots N. A new landmark that finds the map full is dropped and marked
            `Status.OVERFLOW`.
        chart: the error P is the covariance of; default `charts.euclidean()`.
        linearize: where Jacobians are taken; default `linearize.at_estimate()`.
        associate: default `association.known()`.
        update: "sequential" corrects place by place, linearizing anew each time, as the guide does;
            "joint" corrects by the whole scan at once.
        gate: reject a measurement whose squared Mahalanobis distance exceeds this; default none.
            The guide's 3 σ is `stats.sigma_gate(3)`, and `stats.chi2_quantile` gives a probability.
        iterations: passes of the iterated EKF, each from the same prior; 1 is the plain EKF.
        joseph: Joseph's form of the covariance update; dearer, and safer in float32.
        births: at most so many new landmarks a scan, the rest `Status.DEFERRED`; the guide starts
            one. Default no limit.
        square_root: hold a root X of P = X Xᵀ instead of P, in which float32 goes as far as float64
            does in P; the same filter, dearer (the prediction is O(N³)).
        life: which landmarks stay in the map (`jaxslam.life`); default all.
        watch: keep a `slots.Watch` in the state, which campaigns report.
    Raises:
        ValueError: on a capacity, iterations or births below 1, a gate not above 0, an unknown
            update, a chart or linearizer that does not fit the sensor's landmarks or one another,
            a life that is none, Joseph's form of a square root, or several iterations of a
            statistical linearizer.
    """
    chart = chart or euclidean()
    linearize = linearize or at_estimate()
    associate = associate or known_association()
    _check(sensor, chart, capacity, update, gate, iterations, births)
    if life is not None and not isinstance(life, Life):
        raise ValueError(
            f"ekf_slam: expected life to be a Life, as of life.existence, got {life!r}"
        )
    _check_parts(sensor, chart, linearize, iterations, joseph, square_root)
    size_l, size_z = len(sensor.landmark), len(sensor.measurements)
    propagate = partial(
        propagation.propagate,
        motion=motion,
        chart=chart,
        linearize=linearize,
        square_root=square_root,
    )
    options: dict[str, Any] = {
        "sensor": sensor,
        "chart": chart,
        "linearize": linearize,
        "gate": gate,
        "iterations": iterations,
        "joseph": joseph,
        "square_root": square_root,
    }
    predict_scan = partial(
        prediction_of,
        sensor=sensor,
        chart=chart,
        linearize=linearize,
        square_root=square_root,
    )
    at_once = partial(correction.correct, **options)
    in_turn = partial(correction.correct_in_turn, **options)
    augment = partial(
        augmentation.augment,
        sensor=sensor,
        chart=chart,
        linearize=linearize,
        square_root=square_root,
    )

    def init(pose: jax.Array, pose_cov: jax.Array) -> Joint:
        ground = jnp.zeros((capacity, size_l), pose.dtype)
        turn = jnp.stack([-pose[1], pose[0], jnp.ones_like(pose[0])])
        if chart.basis is not None:
            undo = linalg.inverse(chart.basis(pose, ground[0]).pose)
            pose_cov, turn = undo @ pose_cov @ undo.T, undo @ turn
        lin = linearize.init(pose, ground)
        joint = slots.empty(
            pose,
            pose_cov,
            capacity,
            size_l,
            lin,
            square_root=square_root,
            turn=turn if watch else None,
            motion_apart=chart.motion_apart,
        )
        return joint if life is None else joint._replace(life=life.init(pose, joint.landmarks))

    def without(joint: Joint, dead: jax.Array) -> Joint:
        kept = partial(slots.remove, square_root=square_root)
        return where_any(dead.any(), lambda joint: kept(joint, dead), lambda joint: joint, joint)

    def predict(joint: Joint, u: jax.Array, key: jax.Array) -> Joint:
        return propagate(joint, u)

    def update_map(joint: Joint, scan: Scan, key: jax.Array) -> tuple[Joint, Info]:
        # Padding may hold anything, and is multiplied by zero further down.
        z = jnp.where(scan.valid[:, None], scan.z, 0.0)
        if size_l > 0:
            found = Association(*associate(predict_scan(joint), scan._replace(z=z)))
            slot, is_new, exhausted = found.slot, found.is_new, jnp.asarray(found.exhausted)
            matched = scan.valid & (slot >= 0) & ~is_new
            is_new = scan.valid & is_new
        else:
            slot, is_new = jnp.full_like(scan.tag, -1), jnp.zeros_like(scan.valid)
            matched, exhausted = scan.valid, jnp.asarray(False)
        parts = (z, jnp.maximum(slot, 0), matched)
        correct = at_once if update == "joint" and len(scan.tag) > 0 else in_turn
        joint, done = correct(joint, *parts)

        def start(joint: Joint) -> tuple[Joint, Births]:
            repeated = is_new & _seen_before(scan.tag, is_new)
            wanted = is_new & ~repeated
            quota = wanted.shape[0] if births is None else births
            deferred = wanted & (jnp.cumsum(wanted) > quota)
            wanted = wanted & ~deferred
            given_up = jnp.zeros_like(joint.alive)
            if life is not None and life.make_room is not None:
                needed = wanted.sum() - (~joint.alive).sum()
                given_up = life.make_room(joint, needed)
                joint = without(joint, given_up)
            slot, granted = slots.allocate(joint.alive, wanted)
            joint = augment(joint, z, scan.tag, slot, granted)
            return joint, Births(slot, granted, deferred, repeated, given_up)

        def start_none(joint: Joint) -> tuple[Joint, Births]:
            none, given_up = jnp.zeros_like(is_new), jnp.zeros_like(joint.alive)
            return joint, Births(jnp.zeros_like(slot), none, none, none, given_up)

        joint, born = where_any(is_new.any(), start, start_none, joint)

        status = jnp.select(
            [
                matched & ~done.inside,
                matched & ~done.positive,
                matched,
                born.repeated,
                born.deferred,
                born.granted,
                is_new,
                scan.valid,
            ],
            [
                Status.REJECTED,
                Status.SINGULAR,
                Status.FUSED,
                Status.REPEATED,
                Status.DEFERRED,
                Status.BORN,
                Status.OVERFLOW,
                Status.UNMATCHED,
            ],
            Status.EMPTY,
        ).astype(jnp.int32)
        fused = status == Status.FUSED
        info = Info(
            nis=jnp.where(matched, done.nis, 0.0),
            dof=jnp.where(fused, size_z, 0),
            innovation=jnp.where(matched[:, None], done.innovation, 0.0),
            innovation_cov=jnp.where(matched[:, None, None], done.innovation_cov, 0.0),
            slot=jnp.where(fused, slot, jnp.where(born.granted, born.slot, -1)),
            status=status,
            log_likelihood=done.log_likelihood.sum(),
            exhausted=exhausted,
        )
        if life is not None:
            memory, dead = life.after(joint, info, lambda: estimate(joint))
            joint = without(joint._replace(life=memory), dead)
            info = info._replace(removed=dead | born.given_up)
        return joint, info

    def estimate(joint: Joint) -> Estimate:
        cov = joint.cov @ joint.cov.T if square_root else joint.cov
        return _moments(joint._replace(cov=cov), sensor, chart)

    return Filter(
        name="ekf_slam",
        control_size=len(motion.controls),
        measurement_size=size_z,
        init=init,
        predict=predict,
        update=update_map,
        estimate=estimate,
        chart=chart,
    )


def _moments(joint: Joint, sensor: Sensor, chart: Chart) -> Estimate:
    """Means and marginal covariances in map coordinates, whatever the chart and the landmark."""
    capacity, size = joint.landmarks.shape
    pose_cov = joint.cov[:3, :3]
    every = jnp.arange(capacity)
    own_covs = joint.cov[3:, 3:].reshape(capacity, size, capacity, size)[every, :, every]
    with_pose = joint.cov[3:, :3].reshape(capacity, size, 3)

    def point(
        landmark: jax.Array, own: jax.Array, by_robot: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        by_landmark = jax.jacfwd(sensor.position)(landmark)
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            if basis.landmark is not None:
                own, by_robot = basis.landmark @ own @ basis.landmark.T, basis.landmark @ by_robot
            cross = basis.cross @ by_robot.T
            own = own + cross + cross.T
            own = own + basis.cross @ pose_cov @ basis.cross.T
        return sensor.position(landmark), by_landmark @ own @ by_landmark.T

    points, point_covs = jax.vmap(point)(joint.landmarks, own_covs, with_pose)
    if chart.basis is not None:
        basis = chart.basis(joint.pose, joint.landmarks[0])
        pose_cov = basis.pose @ pose_cov @ basis.pose.T
    # The position of a landmark of zeros may be anything (of an inverse depth, 1000 km away).
    unit = jnp.eye(2, dtype=point_covs.dtype)[None]
    return Estimate(
        pose=joint.pose,
        pose_cov=pose_cov,
        points=jnp.where(joint.alive[:, None], points, 0.0),
        point_covs=jnp.where(joint.alive[:, None, None], point_covs, unit),
        alive=joint.alive,
        tag=joint.tag,
    )


def _seen_before(tag: jax.Array, among: jax.Array) -> jax.Array:
    """Whether the same non-negative tag occurs at an earlier place, (M,)."""
    earlier = jnp.tril(jnp.ones((tag.shape[0], tag.shape[0]), bool), -1)
    same = (tag[:, None] == tag[None, :]) & (tag >= 0)[:, None] & among[None, :]
    return (same & earlier).any(axis=1)


def _check(
    sensor: Sensor,
    chart: Chart,
    capacity: int,
    update: str,
    gate: float | None,
    iterations: int,
    births: int | None,
) -> None:
    for name, value in (("capacity", capacity), ("iterations", iterations), ("births", births)):
        if value is not None:
            check_count(f"ekf_slam: {name}", value)
    if update not in ("sequential", "joint"):
        raise ValueError(f'ekf_slam: expected update "sequential" or "joint", got {update!r}')
    if gate is not None and is_concrete(gate) and not gate > 0:
        raise ValueError(f"ekf_slam: expected a gate above 0, got {gate}")
    pose, landmark = jnp.zeros(3), jnp.zeros(len(sensor.landmark))
    try:
        _, moved = jax.eval_shape(chart.retract, pose, landmark, pose, landmark)
        fits = moved.shape == landmark.shape
    except (IndexError, TypeError, ValueError):
        fits = False
    if not fits and landmark.size == 0:
        raise ValueError(
            f"ekf_slam: the chart {chart.name} acts on landmarks, and the absolute sensor "
            f"{sensor.name} has none"
        )
    if not fits:
        raise ValueError(
            f"ekf_slam: the chart {chart.name} does not act on the {landmark.shape[0]}-parameter "
            f"landmarks of the sensor {sensor.name}"
        )


def _check_parts(
    sensor: Sensor,
    chart: Chart,
    linearize: Linearizer,
    iterations: int,
    joseph: bool,
    square_root: bool,
) -> None:
    if linearize.euclidean and (chart.basis is not None or len(sensor.landmark) != 2):
        raise ValueError(
            f"ekf_slam: the linearizer {linearize.name} is for the Euclidean chart and landmarks "
            f"(x, y), not for the chart {chart.name} and the landmarks of {sensor.name}"
        )
    if linearize.name == "unscented" and iterations > 1:
        raise ValueError("ekf_slam: the linearizer unscented does not iterate")
    if chart.motion_apart and square_root:
        raise ValueError(
            f"ekf_slam: the chart {chart.name} keeps the last motion apart, which has no square "
            "root here"
        )
    if joseph and square_root:
        raise ValueError("ekf_slam: Joseph's form is of a covariance, not of its square root")
