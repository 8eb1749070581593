"""Predicted measurements of every landmark of a `Joint`, the input of association."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.association._rules import prediction_from
from jaxslam.core.protocols import LinearizationPoint, Prediction, Sensor
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.correction import KalmanFilter
from jaxslam.filters._ekf.linear_system import chart_jacobians
from jaxslam.filters._ekf.map_coordinates import at_slot
from jaxslam.filters._ekf.whitening import projected_cov
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import materialize


def prediction_of(filter: KalmanFilter, sensor: Sensor, joint: Joint) -> Prediction:
    """The `Prediction` of a map; only the parts that the association calls are computed.

    As in `correction`, but of every landmark and without a measurement: ẑ_i and H_i P H_iᵀ, and for
    joint associations H_i P H_jᵀ.
    """

    def measurements() -> tuple[Float[Array, "N Z"], Float[Array, "N Z Z"]]:
        local_cov = _local_covs(filter, joint)
        z_hat, by_pose, by_landmark, added_noise = _linearize_map(filter, sensor, joint, local_cov)
        h = jnp.concatenate([by_pose, by_landmark], axis=2)
        terms = range(h.shape[2])
        hp = materialize(linalg.total(h[:, :, k, None] * local_cov[:, None, k] for k in terms))
        hph = linalg.total(hp[:, :, None, k] * h[:, None, :, k] for k in terms)
        # R(ẑ) follows in `prediction_from`; the linearizer's share is added here.
        return z_hat, materialize(hph + added_noise)

    def cross() -> Float[Array, "N Z N Z"]:
        local_cov = _local_covs(filter, joint)
        _, by_pose, by_landmark, _ = _linearize_map(filter, sensor, joint, local_cov)
        (capacity, size_l), n = joint.landmarks.shape, joint.robot_size
        is_root = filter.covariance == "square_root"
        cov = joint.cov @ joint.cov.T if is_root else joint.cov
        rows = cov[n:].reshape(capacity, size_l, cov.shape[1])
        hp = linalg.total(by_pose[:, :, k, None] * cov[None, None, k] for k in range(n))
        for k in range(size_l):
            hp = hp + by_landmark[:, :, k, None] * rows[:, None, k]
        return projected_cov(hp, by_pose, by_landmark, jnp.arange(capacity), capacity)

    return prediction_from(sensor, joint.tag, joint.alive, measurements, cross)


def _local_covs(filter: KalmanFilter, joint: Joint) -> Float[Array, "N K K"]:
    """P of the robot and each landmark, K = R + L: `slots.local_cov` of all slots in one pass."""
    (capacity, size_l), n = joint.landmarks.shape, joint.robot_size
    if filter.covariance == "square_root":
        robot_rows, rows = joint.cov[:n], joint.cov[n:].reshape(capacity, size_l, -1)
        cross = jnp.einsum("ik,nlk->nil", robot_rows, rows)
        robot, landmarks = robot_rows @ robot_rows.T, jnp.einsum("nlk,nmk->nlm", rows, rows)
    else:
        slot = jnp.arange(capacity)
        # P of landmarks by slot and entry, (N, L, N, L): its diagonal blocks.
        landmarks = joint.cov[n:, n:].reshape(capacity, size_l, capacity, size_l)[slot, :, slot]
        cross = joint.cov[:n, n:].reshape(n, capacity, size_l).transpose(1, 0, 2)
        robot = joint.cov[:n, :n]
    robot, cross, landmarks = materialize((robot, cross, landmarks))
    top = jnp.concatenate([jnp.broadcast_to(robot, (capacity, n, n)), cross], axis=2)
    bottom = jnp.concatenate([cross.transpose(0, 2, 1), landmarks], axis=2)
    return jnp.concatenate([top, bottom], axis=1)


def _linearize_map(
    filter: KalmanFilter, sensor: Sensor, joint: Joint, local_cov: Float[Array, "N K K"]
) -> tuple[
    Float[Array, "N Z"], Float[Array, "N Z R"], Float[Array, "N Z L"], Float[Array, "N Z Z"]
]:
    """The predicted ẑ of each landmark, H by errors of pose and landmark, and the covariance that
    the linearizer adds to R."""
    chart, robot = filter.robot_chart, joint.robot
    z_hat, by_pose, by_landmark, added_noise = jax.vmap(
        lambda slot, landmark, cov: filter.linearize.observe(
            at_slot(sensor, joint, slot),
            LinearizationPoint(joint, chart, robot, cov, slot, landmark),
        )
    )(jnp.arange(len(joint.landmarks)), joint.landmarks, local_cov)
    if chart.basis is not None:
        by_pose, by_landmark = chart_jacobians(chart, robot, joint.landmarks, by_pose, by_landmark)
    linearized: tuple[Array, Array, Array, Array] = materialize(
        (z_hat, by_pose, by_landmark, added_noise)
    )
    return linearized
