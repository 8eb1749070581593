"""The linearized error system of a filter's steps, in the order in which a step applies it.

A step of a filter returns it with its result, as a tuple of the records below, and `monitored`
takes it. Under `jit` what nobody takes costs nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core.protocols import Chart
from jaxslam.core.types import Info, Scan
from jaxslam.math import _linalg as linalg


class Transition(NamedTuple):
    """The error model: [dx; dl_i] ← [A dx + noise; a_i dx + B_i dl_i + noise through dx]."""

    robot: Float[Array, "3 3"]
    """A"""
    cross: Float[Array, "N L 3"] | None
    """a_i; None where landmark errors are constant"""
    landmark: Float[Array, "N L L"] | None
    """B_i; None where they are the identity"""
    noise: Float[Array, "3 3"]
    """noise of the pose's coordinates, to dx"""
    cross_noise: Float[Array, "N L 3"] | None
    """the same, to dl_i"""

    def times(self, matrix: Float[Array, "D k"]) -> Float[Array, "D k"]:
        """The transition matrix times a matrix."""
        robot = linalg.matmul(self.robot, matrix[:3])
        if self.cross is None:
            return matrix.at[:3].set(robot)
        turned = self.turn(matrix)[3:]
        by_robot = linalg.matmul(self.cross.reshape(turned.shape[0], 3), matrix[:3])
        return jnp.concatenate([robot, by_robot + turned])

    def turn(self, matrix: Float[Array, "D k"]) -> Float[Array, "D k"]:
        """The matrix with B_i applied to the landmarks' rows."""
        if self.landmark is None:
            return matrix
        capacity, size = self.landmark.shape[:2]
        rows = matrix[3:].reshape(capacity, size, -1)
        turned = linalg.total(
            self.landmark[:, :, k, None] * rows[:, k, None, :] for k in range(size)
        )
        return jnp.concatenate([matrix[:3], turned.reshape(capacity * size, -1)])

    def lift(self, size: int) -> Float[Array, "D 3"]:
        """The matrix from noise of the pose's coordinates to all errors."""
        rest = jnp.zeros((size - 3, 3), self.noise.dtype)
        if self.cross_noise is not None:
            rest = self.cross_noise.reshape(size - 3, 3)
        return jnp.concatenate([self.noise, rest])


class LinearMeasurements(NamedTuple):
    """m measurements z ⊖ ẑ = H E (dx, dl) + v of the errors of robot and landmark, K = 3 + L."""

    jacobian: Float[Array, "m Z K"]
    """H, by the coordinates of pose and landmark"""
    basis: Float[Array, "m K K"] | None
    """E, the coordinates by the errors; None is the identity"""
    noise: Float[Array, "m Z Z"]
    """the covariance R(ẑ) of v"""
    slot: Int[Array, "m"]
    """of the landmark"""
    fused: Bool[Array, "m"]
    """the measurement corrected the state"""


class LinearLandmarks(NamedTuple):
    """New landmarks, dl = G dx + noise."""

    slot: Int[Array, "m"]
    granted: Bool[Array, "m"]
    """a landmark was started"""
    by_pose: Float[Array, "m L 3"]
    """G, errors by errors"""


LinearSystem = tuple[Transition | LinearMeasurements | LinearLandmarks, ...]


@dataclass(frozen=True, eq=False)
class LinearizedSteps:
    """The steps of a filter with the linear system of each, `Filter.linearized`."""

    predict: Callable[[PyTree, Array, Array], tuple[PyTree, LinearSystem]]
    """(S, u, key) -> S, system."""
    update: Callable[[PyTree, Scan, Array], tuple[PyTree, Info, LinearSystem]]
    """(S, scan, key) -> S, info, system."""


def basis_of_each(
    chart: Chart, pose: Float[Array, "3"], landmarks: Float[Array, "m L"]
) -> Float[Array, "m K K"] | None:
    """The matrix E from errors of pose and one landmark to their coordinates; None: identity."""
    if chart.basis is None:
        return None
    (m, size), still = landmarks.shape, jnp.eye(landmarks.shape[1], dtype=pose.dtype)
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(pose, landmarks)
    landmark = (
        jnp.broadcast_to(still, (m, size, size)) if basis.landmark is None else basis.landmark
    )
    top = jnp.concatenate([basis.pose, jnp.zeros((m, 3, size), pose.dtype)], axis=2)
    return jnp.concatenate([top, jnp.concatenate([basis.cross, landmark], axis=2)], axis=1)
