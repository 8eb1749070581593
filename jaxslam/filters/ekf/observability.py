"""What a correction says along the directions that should stay unobservable: `slots.Watch`."""

import jax
import jax.numpy as jnp

from jaxslam.math import linalg
from jaxslam.protocols import Chart
from jaxslam.slots import Joint, Watch

_TINY = 1e-30


def informed(
    joint: Joint,
    chart: Chart,
    by_pose: jax.Array,
    by_landmark: jax.Array,
    slot: jax.Array,
    noise: jax.Array,
    fused: jax.Array,
) -> Watch:
    """The watch with what these measurements say along its directions; H by coordinates."""
    watch: Watch = joint.watch
    directions = _in_coordinates(chart, joint)

    def whiten(cov: jax.Array, y: jax.Array) -> jax.Array:
        return linalg.solve_lower(linalg.cholesky(cov)[0], y)

    signed = along(by_pose, by_landmark, *directions, slot)
    robot, landmarks = directions
    size = along(jnp.abs(by_pose), jnp.abs(by_landmark), jnp.abs(robot), jnp.abs(landmarks), slot)
    signed = jax.vmap(whiten)(noise, signed)
    size = size / jnp.sqrt(jnp.maximum(jnp.diagonal(noise, axis1=1, axis2=2), _TINY))[:, :, None]
    signed, size = (jnp.where(fused[:, None, None], part, 0.0) for part in (signed, size))
    return watch._replace(
        information=watch.information
        + (signed[:, :, :, None] * signed[:, :, None, :]).sum(axis=(0, 1)),
        scale=watch.scale + (size**2).sum(axis=(0, 1)),
    )


def along(
    by_pose: jax.Array,
    by_landmark: jax.Array,
    robot: jax.Array,
    landmarks: jax.Array,
    slot: jax.Array,
) -> jax.Array:
    """H times directions: of the robot (3, k) and of each landmark (N, L, k); (m, Z, k)."""
    own = landmarks[slot]
    terms = [by_pose[:, :, i, None] * robot[None, None, i] for i in range(3)]
    terms += [by_landmark[:, :, i, None] * own[:, None, i] for i in range(own.shape[1])]
    return linalg.total(terms)


def split(directions: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    """Rows (D, k) as those of the robot (3, k) and of each landmark (N, L, k)."""
    return directions[:3], directions[3:].reshape(capacity, -1, directions.shape[1])


def _in_coordinates(chart: Chart, joint: Joint) -> tuple[jax.Array, jax.Array]:
    """The watched directions in coordinates: of the pose (3, 3) and of each landmark (N, L, 3)."""
    robot, landmarks = split(joint.watch.directions, joint.landmarks.shape[0])
    if chart.basis is None:
        return robot, landmarks
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
    if basis.landmark is not None:
        landmarks = jnp.einsum("nij,njk->nik", basis.landmark, landmarks)
    return basis.pose[0] @ robot, landmarks + basis.cross @ robot
