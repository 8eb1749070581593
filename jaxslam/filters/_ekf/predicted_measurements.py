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
    """The `Prediction` of a map; only the parts that the association calls are computed."""
    chart, square_root = filter.chart, filter.covariance == "square_root"
    capacity, size = joint.landmarks.shape

    def jacobians() -> tuple[
        Float[Array, "N Z"], Float[Array, "N Z 3"], Float[Array, "N Z L"], Float[Array, "N Z Z"]
    ]:
        """The predicted ẑ, H by errors of pose and landmark, and H P Hᵀ, for each landmark."""
        # The blocks of P: of the robot, of it with each landmark, and of each landmark.
        slots = jnp.arange(capacity)
        if square_root:
            robot, rows = joint.cov[:3], joint.cov[3:].reshape(capacity, size, -1)
            cross = jnp.einsum("ik,nlk->nil", robot, rows)
            robot, landmarks = robot @ robot.T, jnp.einsum("nlk,nmk->nlm", rows, rows)
        else:
            landmarks = joint.cov[3:, 3:].reshape(capacity, size, capacity, size)[slots, :, slots]
            cross = joint.cov[:3, 3:].reshape(3, capacity, size).transpose(1, 0, 2)
            robot = joint.cov[:3, :3]
        robot, cross, landmarks = materialize((robot, cross, landmarks))
        top = jnp.concatenate([jnp.broadcast_to(robot, (capacity, 3, 3)), cross], axis=2)
        bottom = jnp.concatenate([cross.transpose(0, 2, 1), landmarks], axis=2)
        local = jnp.concatenate([top, bottom], axis=1)
        expected, by_pose, by_landmark, rest = jax.vmap(
            lambda slot, landmark, cov: filter.linearize.observe(
                at_slot(sensor, joint, slot),
                LinearizationPoint(joint, chart, joint.pose, cov, slot, landmark),
            )
        )(slots, joint.landmarks, local)
        if chart.basis is not None:
            by_pose, by_landmark = chart_jacobians(
                chart, joint.pose, joint.landmarks, by_pose, by_landmark
            )
        expected, by_pose, by_landmark, rest = materialize((expected, by_pose, by_landmark, rest))
        h = jnp.concatenate([by_pose, by_landmark], axis=2)
        hp = materialize(
            linalg.total(h[:, :, k, None] * local[:, None, k] for k in range(3 + size))
        )
        alone = linalg.total(hp[:, :, None, k] * h[:, None, :, k] for k in range(3 + size))
        return expected, by_pose, by_landmark, materialize(alone + rest)

    def measurements() -> tuple[Float[Array, "N Z"], Float[Array, "N Z Z"]]:
        expected, _, _, landmark = jacobians()
        return expected, landmark

    def cross() -> Float[Array, "N Z N Z"]:
        _, by_pose, by_landmark, _ = jacobians()
        cov = joint.cov @ joint.cov.T if square_root else joint.cov
        rows = cov[3:].reshape(capacity, size, cov.shape[1])
        hp = linalg.total(by_pose[:, :, k, None] * cov[None, None, k] for k in range(3))
        for k in range(size):
            hp = hp + by_landmark[:, :, k, None] * rows[:, None, k]
        return projected_cov(hp, by_pose, by_landmark, jnp.arange(capacity), capacity)

    return prediction_from(sensor, joint.tag, joint.alive, measurements, cross)
