"""What a Kalman-type SLAM filter believes, in map coordinates."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxslam.filters.ekf.to_points import seen_as
from jaxslam.protocols import Chart, Sensor
from jaxslam.slots import Joint
from jaxslam.types import Estimate


def moments(joint: Joint, sensor: Sensor, chart: Chart) -> Estimate:
    """Means and marginal covariances in map coordinates, whatever the chart and the landmark."""
    capacity, size = joint.landmarks.shape
    pose_cov = joint.cov[:3, :3]
    every = jnp.arange(capacity)
    own_covs = joint.cov[3:, 3:].reshape(capacity, size, capacity, size)[every, :, every]
    with_pose = joint.cov[3:, :3].reshape(capacity, size, 3)

    def point(
        landmark: jax.Array, own: jax.Array, by_robot: jax.Array, reduced: Any
    ) -> tuple[jax.Array, jax.Array]:
        position = seen_as(sensor, reduced).position
        by_landmark = jax.jacfwd(position)(landmark)
        if chart.basis is not None:
            basis = chart.basis(joint.pose, landmark)
            if basis.landmark is not None:
                own, by_robot = basis.landmark @ own @ basis.landmark.T, basis.landmark @ by_robot
            cross = basis.cross @ by_robot.T
            own = own + cross + cross.T
            own = own + basis.cross @ pose_cov @ basis.cross.T
        return position(landmark), by_landmark @ own @ by_landmark.T

    points, point_covs = jax.vmap(point)(joint.landmarks, own_covs, with_pose, joint.reduced)
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
