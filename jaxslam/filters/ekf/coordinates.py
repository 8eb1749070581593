"""The covariance of a `Joint` in coordinates (x, y, θ, l), whatever chart the filter has."""

import jax
import jax.numpy as jnp

from jaxslam.filters.ekf.predict import Transition, moved_cov
from jaxslam.math import linalg
from jaxslam.protocols import Chart
from jaxslam.slots import Joint


def cov_of_coordinates(joint: Joint, chart: Chart, *, square_root: bool = False) -> jax.Array:
    """E P Eᵀ (D, D) with E the chart's basis at the estimate, block lower triangular; O(N²)."""
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
    joint: Joint, chart: Chart, cov: jax.Array, *, square_root: bool = False
) -> Joint:
    """The state whose covariance in coordinates is cov (D, D), at its own estimate."""
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


def retracted(chart: Chart, joint: Joint, xi: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Pose (3,) and landmarks (N, L) moved by errors ξ (D,)."""
    over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
    poses, landmarks = over_landmarks(
        joint.pose, joint.landmarks, xi[:3], xi[3:].reshape(joint.landmarks.shape)
    )
    return poses[0], jnp.where(joint.alive[:, None], landmarks, 0.0)
