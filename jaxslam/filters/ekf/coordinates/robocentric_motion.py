"""The last motion as a separate variable of the state (`Chart.motion_apart`).

The errors of the map are e = e_rest + g δ, with δ the error of the last motion and g its Jacobian.
A correction updates e_rest and δ, and then composes the map with the corrected motion.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.filters.ekf.coordinates.linear_system import Transition
from jaxslam.filters.ekf.steps.predict import in_charts, moved_cov
from jaxslam.linearize.first_order import with_lever_arm
from jaxslam.math import linalg, se2
from jaxslam.math.angles import wrap
from jaxslam.protocols import Chart
from jaxslam.slots import Joint


def lever_of_motion(joint: Joint, chart: Chart) -> Float[Array, "D 3"]:
    """The Jacobian g of all errors by the error of the last motion in its own frame."""
    assert chart.basis is not None
    still = jnp.eye(3, dtype=joint.pose.dtype)
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
    return lever_by(in_charts(still, basis, basis, joint.alive), joint.last.frame)


def lever_by(moved: Transition, frame: Float[Array, ""]) -> Float[Array, "D 3"]:
    """The Jacobian g, by a transition to the current chart and the heading before the motion."""
    assert moved.cross_noise is not None
    size = 3 + moved.cross_noise[..., 0].size
    return linalg.matmul(moved.lift(size), out_of(frame))


def moved_anew(
    joint: Joint,
    turn: Float[Array, ""],
    step: Float[Array, "3"],
    lever: Float[Array, "D 3"],
    chart: Chart,
) -> tuple[Joint, Transition]:
    """The corrected map composed with the last motion, which a step has corrected; and T.

    With T the transition of e_rest and h = g' - T g, P ← T P Tᵀ + h C Tᵀ + (h C Tᵀ)ᵀ + h Q hᵀ,
    C = cov(δ, e) and Q = cov(δ), all after the correction.

    Args:
        turn: the rotation of the frame in which the motion began.
        lever: g as it was before the correction.
    """
    assert chart.basis is not None
    frame = joint.last.frame + turn
    change = linalg.matmul(out_of(frame), step[:, None])[:, 0]
    pose = joint.pose + change
    pose = jnp.concatenate([pose[:2], wrap(pose[2:])])
    over_map = jax.vmap(chart.basis, in_axes=(None, 0))
    before, after = over_map(joint.pose, joint.landmarks), over_map(pose, joint.landmarks)
    still = jnp.eye(3, dtype=pose.dtype)
    moved = in_charts(with_lever_arm(still, change[:2]), before, after, joint.alive)
    composed = joint._replace(pose=pose, last=joint.last._replace(frame=frame))
    h = (lever_by(moved, frame) - moved.times(lever)).T
    cov_last = moved.times(joint.last.cov.T).T
    half = cov_last + 0.5 * linalg.matmul(joint.last.own, h)
    composed = composed._replace(
        cov=moved_cov(joint.cov, moved, None, (h, half)),
        last=composed.last._replace(cov=cov_last + linalg.matmul(joint.last.own, h)),
    )
    return composed, moved


def unmoved(joint: Joint, chart: Chart) -> Transition:
    """The transition of a map that is not composed anew."""
    assert chart.basis is not None
    capacity, size = joint.landmarks.shape
    still = jnp.eye(3, dtype=joint.pose.dtype)
    cross = jnp.zeros((capacity, size, 3), joint.pose.dtype)
    landmark = None
    if chart.basis(joint.pose, joint.landmarks[0]).landmark is not None:
        landmark = jnp.broadcast_to(jnp.eye(size, dtype=cross.dtype), (capacity, size, size))
    return Transition(still, cross, landmark, still, cross)


def out_of(frame: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Steps of the pose in a frame of that heading, expressed in the map."""
    return se2.adjoint(jnp.stack([jnp.zeros_like(frame), jnp.zeros_like(frame), frame]))
