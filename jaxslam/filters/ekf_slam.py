"""EKF-SLAM: the one Kalman-type SLAM filter, of which the published variants are arguments."""

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.filters import gaussian
from jaxslam.linalg import check_count, is_concrete
from jaxslam.linearize.at_estimate import at_estimate
from jaxslam.protocols import Associate, Chart, Filter, Linearizer, Motion, Prediction, Sensor
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan, Status


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
    Raises:
        ValueError: on a capacity, iterations or births below 1, a gate not above 0, an unknown
            update, or a chart that does not fit the sensor's landmarks.
    """
    chart = chart or euclidean()
    linearize = linearize or at_estimate()
    associate = associate or known_association()
    _check(sensor, chart, capacity, update, gate, iterations, births)
    size_l, size_z = len(sensor.landmark), len(sensor.measurements)
    propagate = partial(gaussian.propagate, motion=motion, chart=chart, linearize=linearize)
    augment = partial(gaussian.augment, sensor=sensor, chart=chart, linearize=linearize)
    correct = partial(
        gaussian.correct,
        sensor=sensor,
        chart=chart,
        linearize=linearize,
        gate=gate,
        iterations=iterations,
        joseph=joseph,
    )

    def init(pose: jax.Array, pose_cov: jax.Array) -> Joint:
        lin = linearize.init(capacity, pose)
        joint = slots.empty(pose, pose_cov, capacity, size_l, lin)
        if chart.basis is None:
            return joint
        undo = jnp.linalg.inv(chart.basis(pose, joint.landmarks[0]).pose)
        return joint._replace(cov=joint.cov.at[:3, :3].set(undo @ pose_cov @ undo.T))

    def predict(joint: Joint, u: jax.Array, key: jax.Array) -> Joint:
        return propagate(joint, u)

    def update_map(joint: Joint, scan: Scan, key: jax.Array) -> tuple[Joint, Info]:
        if size_l > 0:
            slot, is_new = associate(Prediction(joint.tag, joint.alive), scan)
            matched = scan.valid & (slot >= 0) & ~is_new
            is_new = scan.valid & is_new
        else:
            slot, is_new = jnp.full_like(scan.tag, -1), jnp.zeros_like(scan.valid)
            matched = scan.valid
        parts = (scan.z, jnp.maximum(slot, 0), matched)
        if update == "joint" and scan.tag.shape[0] > 0:
            joint, done = correct(joint, *parts)
        else:
            # One measurement a pass: the place axis becomes time, with m = 1 inside.
            one_by_one = jax.tree.map(lambda part: part[:, None], parts)
            joint, done = jax.lax.scan(lambda j, part: correct(j, *part), joint, one_by_one)
            done = jax.tree.map(lambda part: part[:, 0], done)

        repeated = is_new & _seen_before(scan.tag, is_new)
        wanted = is_new & ~repeated
        quota = wanted.shape[0] if births is None else births
        deferred = wanted & (jnp.cumsum(wanted) > quota)
        new_slot, granted = slots.allocate(joint.alive, wanted & ~deferred)
        joint = augment(joint, scan.z, scan.tag, new_slot, granted)

        status = jnp.select(
            [
                matched & ~done.inside,
                matched & ~done.positive,
                matched,
                repeated,
                deferred,
                granted,
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
                Status.REJECTED,
            ],
            Status.EMPTY,
        ).astype(jnp.int32)
        fused = status == Status.FUSED
        info = Info(
            nis=jnp.where(matched, done.nis, 0.0),
            dof=jnp.where(fused, size_z, 0),
            innovation=jnp.where(matched[:, None], done.innovation, 0.0),
            innovation_cov=jnp.where(matched[:, None, None], done.innovation_cov, 0.0),
            slot=jnp.where(fused, slot, jnp.where(granted, new_slot, -1)),
            status=status,
            log_likelihood=done.log_likelihood.sum(),
        )
        return joint, info

    def estimate(joint: Joint) -> Estimate:
        return _moments(joint, sensor, chart)

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
            cross = basis.cross @ by_robot.T @ basis.landmark.T
            own = basis.landmark @ own @ basis.landmark.T + cross + cross.T
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
