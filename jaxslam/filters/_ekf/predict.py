"""The prediction of a Kalman-type SLAM filter, for any chart and linearizer."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxslam.core import slots
from jaxslam.core.protocols import Basis, LinearizationPoint, Motion
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.ekf_settings import EkfSettings
from jaxslam.filters._ekf.linear_system import Transition
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import materialize


def propagate(
    joint: Joint, u: Float[Array, "U"], motion: Motion, settings: EkfSettings
) -> tuple[Joint, Transition]:
    """The state after the robot's motion, and the transition of its errors: Solà (14)-(17).

    pose ← f(pose, u, 0), P_RR ← F P_RR Fᵀ + W Q Wᵀ, P_RM ← F P_RM; O(N). In another chart the
    errors of the landmarks change too, by A = E(x')⁻¹ F E(x), E the chart's basis; O(N²), block by
    block. A square root X of P = X Xᵀ becomes the triangular root of [A X, G √N]; O(N³).
    """
    chart, square_root = settings.chart, settings.square_root
    robot = slots.robot_cov(joint, square_root)
    point = LinearizationPoint(joint, chart, joint.pose, robot)
    pose, by_pose, noise, lin = settings.linearize.motion(motion, u, point)
    if chart.basis is None:
        moved = Transition(by_pose, None, None, jnp.eye(3, dtype=noise.dtype), None)
    else:
        pose = materialize(pose)
        over_map = jax.vmap(chart.basis, in_axes=(None, 0))
        before, after = over_map(joint.pose, joint.landmarks), over_map(pose, joint.landmarks)
        moved = _in_charts(by_pose, before, after, joint.alive)
    if square_root:
        size = joint.cov.shape[0]
        added = moved.lift(size) @ linalg.cholesky(noise)[0]
        cov = linalg.triangular_root(jnp.concatenate([moved.times(joint.cov), added], axis=1))
    else:
        cov = moved_cov(joint.cov, moved, noise)
    return joint._replace(pose=pose, cov=cov, lin=lin), moved


def _in_charts(
    by_pose: Float[Array, "3 3"], before: Basis, after: Basis, alive: Bool[Array, "N"]
) -> Transition:
    """The blocks of E(x')⁻¹ F E(x) and E(x')⁻¹, with dead slots unchanged."""
    times = jax.vmap(linalg.matmul, in_axes=(0, None))
    each = jax.vmap(linalg.matmul)
    undo = linalg.inverse(after.pose[0])
    robot = linalg.matmul(linalg.matmul(undo, by_pose), before.pose[0])
    cross = before.cross - times(after.cross, robot)
    cross_noise = -times(after.cross, undo)
    landmark = None
    if before.landmark is not None and after.landmark is not None:
        by_landmark = jax.vmap(linalg.inverse)(after.landmark)
        still = jnp.eye(by_landmark.shape[-1], dtype=by_landmark.dtype)
        landmark = jnp.where(alive[:, None, None], each(by_landmark, before.landmark), still)
        cross, cross_noise = each(by_landmark, cross), each(by_landmark, cross_noise)
    cross, cross_noise = (jnp.where(alive[:, None, None], m, 0.0) for m in (cross, cross_noise))
    return materialize(Transition(robot, cross, landmark, undo, cross_noise))


def moved_cov(
    cov: Float[Array, "D D"], moved: Transition, noise: Float[Array, "3 3"] | None
) -> Float[Array, "D D"]:
    """The predicted covariance A P Aᵀ + G N Gᵀ, each entry of P written once or twice."""
    if moved.cross is None:
        robot = linalg.matmul(moved.robot, cov[:3])
        robot_cov = linalg.matmul(robot[:, :3], moved.robot.T)
        robot_cov = linalg.symmetrize(robot_cov if noise is None else robot_cov + noise)
        # Stored separately from P, from which it is computed, so that P is written in place.
        robot = materialize(jnp.concatenate([robot_cov, robot[:, 3:]], axis=1))
        return jnp.asarray(cov).at[:3].set(robot).at[:, :3].set(robot.T)
    if moved.landmark is not None:
        # Stored before it is transposed; otherwise each entry would be computed twice.
        cov = materialize(moved.turn(moved.turn(cov).T))
    cov = linalg.symmetrize(cov)
    # A = I + b e_Rᵀ, so with T = P_R + P_RR bᵀ/2 the change of P is b T + (b T)ᵀ.
    b = jnp.concatenate([moved.robot - jnp.eye(3, dtype=cov.dtype), moved.cross.reshape(-1, 3)])
    half = cov[:3] + 0.5 * linalg.matmul(cov[:3, :3], b.T)
    change = linalg.gram_both(*materialize((b.T, half)))
    if noise is not None:
        added = linalg.matmul(moved.lift(cov.shape[0]), linalg.cholesky(noise)[0]).T
        change = change + linalg.self_gram(materialize(added))
    return cov + change
