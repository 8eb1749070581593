"""Information gained along directions that should stay unobservable: `slots.Watch`."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.math import linalg
from jaxslam.protocols import Chart
from jaxslam.slots import Joint, Watch

_TINY = 1e-30


def with_information(
    joint: Joint,
    chart: Chart,
    by_pose: Float[Array, "m Z 3"],
    by_landmark: Float[Array, "m Z L"],
    slot: Int[Array, "m"],
    noise: Float[Array, "m Z Z"],
    fused: Bool[Array, "m"],
) -> Watch:
    """The watch with the information of these measurements added; H by coordinates."""
    watch: Watch = joint.watch
    directions = _in_coordinates(chart, joint)

    def whiten(cov: Float[Array, "Z Z"], y: Float[Array, "Z k"]) -> Float[Array, "Z k"]:
        return linalg.solve_lower(linalg.cholesky(cov)[0], y)

    signed = times_directions(by_pose, by_landmark, *directions, slot)
    robot, landmarks = directions
    size = times_directions(
        jnp.abs(by_pose), jnp.abs(by_landmark), jnp.abs(robot), jnp.abs(landmarks), slot
    )
    signed = jax.vmap(whiten)(noise, signed)
    size = size / jnp.sqrt(jnp.maximum(jnp.diagonal(noise, axis1=1, axis2=2), _TINY))[:, :, None]
    signed, size = (jnp.where(fused[:, None, None], part, 0.0) for part in (signed, size))
    return watch._replace(
        information=watch.information
        + (signed[:, :, :, None] * signed[:, :, None, :]).sum(axis=(0, 1)),
        scale=watch.scale + (size**2).sum(axis=(0, 1)),
    )


def times_directions(
    by_pose: Float[Array, "m Z 3"],
    by_landmark: Float[Array, "m Z L"],
    robot: Float[Array, "3 k"],
    landmarks: Float[Array, "N L k"],
    slot: Int[Array, "m"],
) -> Float[Array, "m Z k"]:
    """H times k directions of the robot and of each landmark."""
    own = landmarks[slot]
    terms = [by_pose[:, :, i, None] * robot[None, None, i] for i in range(3)]
    terms += [by_landmark[:, :, i, None] * own[:, None, i] for i in range(own.shape[1])]
    return linalg.total(terms)


def split_directions(
    directions: Float[Array, "D k"], capacity: int
) -> tuple[Float[Array, "3 k"], Float[Array, "N L k"]]:
    """The directions split into rows of the robot and of each landmark."""
    return directions[:3], directions[3:].reshape(capacity, -1, directions.shape[1])


def _in_coordinates(
    chart: Chart, joint: Joint
) -> tuple[Float[Array, "3 3"], Float[Array, "N L 3"]]:
    """The watched directions in map coordinates: of the pose and of each landmark."""
    robot, landmarks = split_directions(joint.watch.directions, joint.landmarks.shape[0])
    if chart.basis is None:
        return robot, landmarks
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
    if basis.landmark is not None:
        landmarks = jnp.einsum("nij,njk->nik", basis.landmark, landmarks)
    return basis.pose[0] @ robot, landmarks + basis.cross @ robot
