"""The linearized error system of a filter's steps, and its errors in a chart.

A step of a filter returns its system with its result, as a tuple of the records below in the order
in which the step applies them, and `Monitored` takes it. An unused system costs nothing in `jit`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core.protocols import Basis, Chart
from jaxslam.core.slots import Joint
from jaxslam.core.types import Info, Scan
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import materialize


class Transition(NamedTuple):
    """The error model: [dx; dl_i] ← [A dx + noise; a_i dx + B_i dl_i + noise through dx].

    dx has R numbers: 3 of the pose, and E further ones of the robot where its state has them.
    """

    robot: Float[Array, "R R"]
    """A"""
    cross: Float[Array, "N L R"] | None
    """a_i; None where landmark errors are constant"""
    landmark: Float[Array, "N L L"] | None
    """B_i; None where they are the identity"""
    noise: Float[Array, "R R"]
    """noise of the pose's coordinates, to dx"""
    cross_noise: Float[Array, "N L R"] | None
    """the same, to dl_i"""

    def times(self, matrix: Float[Array, "D k"]) -> Float[Array, "D k"]:
        """The transition matrix times a matrix."""
        n = len(self.robot)
        robot = linalg.matmul(self.robot, matrix[:n])
        if self.cross is None:
            return matrix.at[:n].set(robot)
        # a_i dx + B_i dl_i: the landmarks' rows need the robot's as they were.
        turned = self.turn(matrix)[n:]
        by_robot = linalg.matmul(self.cross.reshape(turned.shape[0], n), matrix[:n])
        return jnp.concatenate([robot, by_robot + turned])

    def turn(self, matrix: Float[Array, "D k"]) -> Float[Array, "D k"]:
        """The matrix with B_i applied to the landmarks' rows."""
        if self.landmark is None:
            return matrix
        (capacity, size), n = self.landmark.shape[:2], len(self.robot)
        # (N, L, k): rows of P by landmark and entry.
        rows = matrix[n:].reshape(capacity, size, -1)
        turned = linalg.total(
            self.landmark[:, :, k, None] * rows[:, k, None, :] for k in range(size)
        )
        return jnp.concatenate([matrix[:n], turned.reshape(capacity * size, -1)])

    def lift(self, size: int) -> Float[Array, "D R"]:
        """The matrix from noise of the robot's coordinates to all errors."""
        n = len(self.noise)
        rest = jnp.zeros((size - n, n), self.noise.dtype)
        if self.cross_noise is not None:
            rest = self.cross_noise.reshape(size - n, n)
        return jnp.concatenate([self.noise, rest])


class LinearMeasurements(NamedTuple):
    """m measurements z ⊖ ẑ = H E (dx, dl) + v of the errors of robot and landmark, K = R + L."""

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
    by_pose: Float[Array, "m L R"]
    """G, errors by errors"""


LinearSystem = tuple[Transition | LinearMeasurements | LinearLandmarks, ...]


@dataclass(frozen=True, eq=False)
class LinearizedSteps:
    """The steps of a filter with the linear system of each, `Filter.linearized`."""

    predict: Callable[[PyTree, Array, Array], tuple[PyTree, LinearSystem]]
    """(S, u, key) -> S, system."""
    update: Callable[[PyTree, Scan, Array], tuple[PyTree, Info, LinearSystem]]
    """(S, scan, key) -> S, info, system."""


def transition_in_chart(
    chart: Chart, by_pose: Float[Array, "R R"], joint: Joint, pose: Float[Array, "R"]
) -> Transition:
    """The transition of the errors in a chart, E(x')⁻¹ F E(x), and E(x')⁻¹, E the chart's basis.

    F = by_pose is the derivative of the new pose by that of `joint`; the landmarks do not move. The
    errors of dead slots do not change.
    """
    assert chart.basis is not None
    # With E = [E_x 0; c E_l] of a landmark, which does not move itself,
    # dl' = E_l'⁻¹ (c dx + E_l dl - c' dx').
    over_map = jax.vmap(chart.basis, in_axes=(None, 0))
    before: Basis = over_map(joint.robot, joint.landmarks)
    after: Basis = over_map(pose, joint.landmarks)
    times = jax.vmap(linalg.matmul, in_axes=(0, None))
    products = jax.vmap(linalg.matmul)
    alive = joint.alive[:, None, None]
    undo = linalg.inverse(after.pose[0])
    robot = linalg.matmul(linalg.matmul(undo, by_pose), before.pose[0])
    cross = before.cross - times(after.cross, robot)
    cross_noise = -times(after.cross, undo)
    landmark = None
    if before.landmark is not None and after.landmark is not None:
        by_landmark = jax.vmap(linalg.inverse)(after.landmark)
        unit = jnp.eye(by_landmark.shape[-1], dtype=by_landmark.dtype)
        landmark = jnp.where(alive, products(by_landmark, before.landmark), unit)
        cross, cross_noise = products(by_landmark, cross), products(by_landmark, cross_noise)
    cross, cross_noise = (jnp.where(alive, block, 0.0) for block in (cross, cross_noise))
    return materialize(Transition(robot, cross, landmark, undo, cross_noise))


def moved_cov(
    cov: Float[Array, "D D"], moved: Transition, noise: Float[Array, "R R"] | None
) -> Float[Array, "D D"]:
    """The covariance A P Aᵀ + G N Gᵀ after a transition in a chart, O(N²), block by block."""
    assert moved.cross is not None
    if moved.landmark is not None:
        # Stored before it is transposed; otherwise each entry would be computed twice.
        cov = materialize(moved.turn(moved.turn(cov).T))
    cov = linalg.symmetrize(cov)
    # A = I + b e_Rᵀ, so with T = P_R + P_RR bᵀ/2 the change of P is b T + (b T)ᵀ.
    n = len(moved.robot)
    b = jnp.concatenate([moved.robot - jnp.eye(n, dtype=cov.dtype), moved.cross.reshape(-1, n)])
    half = cov[:n] + 0.5 * linalg.matmul(cov[:n, :n], b.T)
    change = linalg.gram_both(*materialize((b.T, half)))
    if noise is not None:
        # G N Gᵀ by the root of N, (D, R): positive semi-definite and symmetric as it stands.
        added = linalg.matmul(moved.lift(cov.shape[0]), linalg.cholesky(noise)[0]).T
        change = change + linalg.self_gram(materialize(added))
    return cov + change


def chart_jacobians(
    chart: Chart,
    pose: Float[Array, "R"],
    landmarks: Float[Array, "m L"],
    by_pose: Float[Array, "m Z R"],
    by_landmark: Float[Array, "m Z L"],
    errors: tuple[Float[Array, "R"], Float[Array, "m L"]] | None = None,
) -> tuple[Float[Array, "m Z R"], Float[Array, "m Z L"]]:
    """Jacobians by errors of the chart, chained with ∂retract(pose, l, ·) at zero, or at these
    errors (dx, dl)."""
    assert chart.basis is not None
    if errors is None:
        basis = jax.vmap(chart.basis, in_axes=(None, 0))(pose, landmarks)
    else:
        # The basis is the derivative at zero; at ξ_i that of the new pose and then of the new
        # landmark, each by (dx, dl). The pose does not depend on dl.
        of_pose, of_landmark = jax.vmap(
            jax.jacfwd(chart.retract, argnums=(2, 3)), in_axes=(None, 0, None, 0)
        )(pose, landmarks, *errors)
        basis = Basis(of_pose[0], of_landmark[0], of_landmark[1])
    products = jax.vmap(linalg.matmul)
    by_chart = products(by_pose, basis.pose) + products(by_landmark, basis.cross)
    if basis.landmark is None:
        return by_chart, by_landmark
    return by_chart, products(by_landmark, basis.landmark)


def landmark_errors_in_chart(
    chart: Chart,
    pose: Float[Array, "R"],
    landmark: Float[Array, "L"],
    by_pose: Float[Array, "L R"],
    cov: Float[Array, "L L"],
) -> tuple[Float[Array, "L R"], Float[Array, "L L"]]:
    """A new landmark's derivative by the pose and its own covariance, in errors of the chart."""
    if chart.basis is None:
        return by_pose, cov
    basis = chart.basis(pose, landmark)
    # l = g(R, z), by errors: c dx + E_l dl = G E_x dx + noise, solved for dl.
    by_pose = by_pose @ basis.pose - basis.cross
    if basis.landmark is None:
        return by_pose, cov
    undo = linalg.inverse(basis.landmark)
    return undo @ by_pose, undo @ cov @ undo.T


def basis_of_each(
    chart: Chart, pose: Float[Array, "R"], landmarks: Float[Array, "m L"]
) -> Float[Array, "m K K"] | None:
    """The matrix E from errors of pose and one landmark to their coordinates; None: identity."""
    if chart.basis is None:
        return None
    (m, size), n = landmarks.shape, len(pose)
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(pose, landmarks)
    landmark = basis.landmark
    if landmark is None:
        landmark = jnp.broadcast_to(jnp.eye(size, dtype=pose.dtype), (m, size, size))
    # [E_x 0; c E_l] for each measurement.
    top = jnp.concatenate([basis.pose, jnp.zeros((m, n, size), pose.dtype)], axis=2)
    return jnp.concatenate([top, jnp.concatenate([basis.cross, landmark], axis=2)], axis=1)
