"""A `Joint` in map coordinates (x, y, θ, l), whatever the filter's chart: estimate, covariance,
and retraction by errors.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxslam.filters.ekf.coordinates.linear_system import Transition
from jaxslam.filters.ekf.coordinates.to_points import seen_as
from jaxslam.filters.ekf.steps.predict import moved_cov
from jaxslam.math import linalg
from jaxslam.protocols import Chart, Sensor
from jaxslam.slots import Joint
from jaxslam.types import Estimate


def estimate_of(
    joint: Joint, sensor: Sensor, chart: Chart, *, square_root: bool = False
) -> Estimate:
    """Means and marginal covariances in map coordinates, for any chart and landmark parameters."""
    capacity, size = joint.landmarks.shape
    cov = joint.cov @ joint.cov.T if square_root else joint.cov
    pose_cov = cov[:3, :3]
    every = jnp.arange(capacity)
    own_covs = cov[3:, 3:].reshape(capacity, size, capacity, size)[every, :, every]
    with_pose = cov[3:, :3].reshape(capacity, size, 3)

    def point(
        landmark: Float[Array, "L"],
        own: Float[Array, "L L"],
        by_robot: Float[Array, "L 3"],
        reduced: PyTree,
    ) -> tuple[Float[Array, "2"], Float[Array, "2 2"]]:
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


def cov_of_coordinates(
    joint: Joint, chart: Chart, *, square_root: bool = False
) -> Float[Array, "D D"]:
    """The covariance E P Eᵀ (D, D) of coordinates, E the chart's basis at the estimate; O(N²)."""
    cov = joint.cov @ joint.cov.T if square_root else joint.cov
    if chart.basis is None:
        return cov
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
    alive = joint.alive[:, None, None]
    cross = jnp.where(alive, basis.cross, 0.0)
    landmark = basis.landmark
    if landmark is not None:
        landmark = jnp.where(alive, landmark, jnp.eye(landmark.shape[-1], dtype=cov.dtype)[None])
    return moved_cov(cov, Transition(basis.pose[0], cross, landmark, basis.pose[0], None), None)


def with_cov_of_coordinates(
    joint: Joint, chart: Chart, cov: Float[Array, "D D"], *, square_root: bool = False
) -> Joint:
    """The state with covariance cov (D, D) in map coordinates, at the same estimate."""
    if chart.basis is not None:
        basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
        alive = joint.alive[:, None, None]
        undo = linalg.inverse(basis.pose[0])
        cross, landmark = -basis.cross @ undo, None
        if basis.landmark is not None:
            landmark = jax.vmap(linalg.inverse)(basis.landmark)
            cross = landmark @ cross
            landmark = jnp.where(alive, landmark, jnp.eye(cross.shape[1], dtype=cov.dtype)[None])
        cross = jnp.where(alive, cross, 0.0)
        cov = moved_cov(cov, Transition(undo, cross, landmark, undo, None), None)
    return joint._replace(cov=linalg.root_psd(cov) if square_root else cov)


def retracted(
    chart: Chart, joint: Joint, xi: Float[Array, "D"]
) -> tuple[Float[Array, "3"], Float[Array, "N L"]]:
    """Pose (3,) and landmarks (N, L) moved by errors ξ (D,)."""
    over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
    poses, landmarks = over_landmarks(
        joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(joint.landmarks.shape)
    )
    return poses[0], jnp.where(joint.alive[:, None], landmarks, 0.0)
