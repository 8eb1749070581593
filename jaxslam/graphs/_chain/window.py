"""The least-squares problem of a window: a few poses and the map, with a Gaussian prior of both.

    ½ |(x_0, m) ⊖ μ|²_P + ½ Σ_t |η_t|² + ½ Σ_{t,i} |R^{-1/2} (z_ti ⊖ h(x_t, l_i))|²
    with x_t = f(x_{t-1}, u_t, Q_t^{1/2} η_t)

over the oldest pose x_0, the noises η_1 … η_W and the map m. The prior is of x_0 and of the
landmarks measured before it; those first measured inside the window have none. P and Q may be
singular: P is never inverted, and the models hold exactly along the path.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.slots import Joint
from jaxslam.graphs._chain.elimination import (
    Gain,
    LinearizedStep,
    eliminate_steps,
    pose_difference,
    whitened_rows,
)
from jaxslam.linearize._first_order import with_lever_arm
from jaxslam.math import _linalg as linalg
from jaxslam.math.angles import wrap


class WindowPrior(NamedTuple):
    """The Gaussian of the oldest pose and of the landmarks measured before it."""

    joint: Joint
    """mean and covariance; `alive`: its landmarks"""
    points: tuple[Float[Array, "3"], Float[Array, "N L"]]
    """the oldest pose and these landmarks, where first-estimates Jacobians are taken"""


class WindowSteps(NamedTuple):
    """The motions and scans of a window, with leading W; the first ones absent at the start."""

    present: Bool[Array, "W"]
    control: Float[Array, "W U"]
    root: Float[Array, "W Q Q"]
    """square roots of the noise covariances of the motions"""
    z: Float[Array, "W M Z"]
    slot: Int[Array, "W M"]
    used: Bool[Array, "W M"]


class WindowIterate(NamedTuple):
    """Values of all unknowns, and the resulting path."""

    path: Float[Array, "W+1 3"]
    """from the oldest pose on; x_t = f(x_{t-1}, u_t, Q^{1/2} η_t)"""
    noise: Float[Array, "W Q"]
    """η"""
    landmarks: Float[Array, "N L"]


class _WindowSolution(NamedTuple):
    """The deviations from an iterate that solve its linearized problem."""

    pose: Float[Array, "3"]
    """deviation of the oldest pose"""
    landmarks: Float[Array, "N L"]
    gains: Gain
    """gains of the noises, with leading W"""
    cov: Float[Array, "D D"]
    """joint covariance of the oldest pose and the map; zero at dead slots"""


def linearize_window(
    motion: Motion,
    sensor: Sensor,
    prior: WindowPrior,
    steps: WindowSteps,
    at: WindowIterate,
    first: bool,
) -> LinearizedStep:
    """The steps of the window linearized at an iterate, as `LinearizedStep`.

    first: Jacobians by a variable that the prior is of are taken at `WindowPrior.points`,
    everything else at the iterate (Dong-Si & Mourikis 2011, "Motion tracking with fixed-lag
    smoothing: algorithm and consistency analysis", ICRA): prior and new terms then share three
    unobservable directions.
    By the oldest pose F = [I, J(p_1 - p_0); 0, 1] with p_0 at its first estimate,
    J = [0, -1; 1, 0].
    """
    landmark_points = at.landmarks
    if first:
        has_prior = prior.joint.alive[:, None]
        landmark_points = jnp.where(has_prior, prior.points[1], at.landmarks)

    def linearize_motion(
        pose: Array, u: Array, root: Array, noise: Array, present: Array
    ) -> tuple[Array, Array]:
        by_pose, by_noise = jax.jacfwd(motion.step, argnums=(0, 2))(pose, u, root @ noise)
        by_pose = jnp.where(present, by_pose, jnp.eye(3, dtype=pose.dtype))
        return by_pose, jnp.where(present, by_noise @ root, 0.0)

    def linearize_measurement(
        z: Array, slot: Array, used: Array, pose: Array
    ) -> tuple[Array, Array, Array]:
        *rows, positive = whitened_rows(
            sensor, z, pose, at.landmarks[slot], used, landmark_points[slot]
        )
        a, b, r = (jnp.where(used & positive, row, 0.0) for row in rows)
        return a, b, r

    data = steps.control, steps.root, at.noise, steps.present
    by_pose, by_noise = jax.vmap(linearize_motion)(at.path[:-1], *data)
    if first:
        offset = jnp.where(steps.present[0], at.path[0, :2] - prior.points[0][:2], 0.0)
        by_pose = by_pose.at[0].set(with_lever_arm(by_pose[0], offset))
    over_slots = jax.vmap(linearize_measurement, (0, 0, 0, None))
    a, b, r = jax.vmap(over_slots)(steps.z, steps.slot, steps.used, at.path[1:])
    no_drift = jnp.zeros_like(at.path[1:])
    return LinearizedStep(by_pose, by_noise, no_drift, at.noise, steps.slot, a, b, r)


def solve_window(
    prior: WindowPrior, system: LinearizedStep, at: WindowIterate, alive: Bool[Array, "N"]
) -> _WindowSolution:
    """The solution of a linearized window. alive: the landmarks of the map.

    With Λ and y of all steps (`eliminate_steps`) and e = (x_0, m) - μ at the iterate, the
    deviation δ has (I + P Λ) δ = P y - e in the rows of the prior, Λ δ = y in the rows of
    landmarks without one; its covariance is the inverse of that matrix times P, or I.
    """
    joint, (capacity, size) = prior.joint, at.landmarks.shape
    cost, gains, _ = eliminate_steps(system, capacity)
    information = jnp.block([[cost.pose, cost.cross], [cost.cross.T, cost.map]])
    information = linalg.symmetrize(information)
    y = jnp.concatenate([cost.pose_y, cost.map_y])
    # Rows of the prior, and of landmarks without one; those of dead slots are of the identity.
    in_prior = jnp.concatenate([jnp.ones(3, bool), jnp.repeat(joint.alive, size)])
    is_new = jnp.concatenate([jnp.zeros(3, bool), jnp.repeat(alive & ~joint.alive, size)])
    off = jnp.where(joint.alive[:, None], at.landmarks - joint.landmarks, 0.0)
    error = jnp.concatenate([pose_difference(at.path[0], joint.pose), off.reshape(-1)])
    cov = jnp.where(in_prior[:, None] & in_prior[None], joint.cov, 0.0)
    eye = jnp.eye(len(y), dtype=y.dtype)
    matrix = jnp.where(
        in_prior[:, None], eye + cov @ information, jnp.where(is_new[:, None], information, eye)
    )
    right = jnp.where(in_prior, cov @ y - error, jnp.where(is_new, y, 0.0))
    rows = jnp.where(in_prior[:, None], cov, jnp.diag(is_new.astype(y.dtype)))
    delta, of_delta = jnp.linalg.solve(matrix, right), jnp.linalg.solve(matrix, rows)
    landmarks = delta[3:].reshape(capacity, size)
    return _WindowSolution(delta[:3], landmarks, gains, linalg.symmetrize(of_delta))


def step_window(
    motion: Motion, steps: WindowSteps, at: WindowIterate, solved: _WindowSolution
) -> WindowIterate:
    """The iterate after the Gauss-Newton step, by the nonlinear models (see `problem.roll_out`)."""
    delta, gains = solved.landmarks.reshape(-1), solved.gains
    start = at.path[0] + solved.pose
    start = start.at[2].set(wrap(start[2]))

    def forward(pose: Array, row: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        present, u, root, noise, reference, constant, by_pose, by_map = row
        ahead = pose_difference(motion.step(pose, u, root @ noise), reference)
        noise = noise + constant - by_pose @ ahead - by_map @ delta
        noise = jnp.where(present, noise, 0.0)
        pose = jnp.where(present, motion.step(pose, u, root @ noise), pose)
        return pose, (pose, noise)

    data = steps.present, steps.control, steps.root, at.noise, at.path[1:]
    rows = *data, gains.constant, gains.by_pose, gains.by_map
    _, (path, noise) = jax.lax.scan(forward, start, rows)
    return WindowIterate(
        jnp.concatenate([start[None], path]), noise, at.landmarks + solved.landmarks
    )


def newest_cov(system: LinearizedStep, solved: _WindowSolution) -> Float[Array, "D D"]:
    """The covariance of the newest pose and the map.

    With n standard normal and M = R Rᵀ the matrix of a gain,
    δx_t = (I - G J) F δx_{t-1} + G (k - K δm + R⁻ᵀ n), so that δx_W = A δx_0 + B δm + noise.
    """
    wide = solved.cov.shape[0] - 3

    def forward(
        before: tuple[Array, Array, Array], row: tuple[LinearizedStep, Gain]
    ) -> tuple[tuple[Array, Array, Array], None]:
        by_start, by_map, pose_cov = before
        step, gain = row
        closed = step.by_pose - step.by_noise @ (gain.by_pose @ step.by_pose)
        spread = linalg.solve_lower(gain.factor, step.by_noise.T)
        by_map = closed @ by_map - step.by_noise @ gain.by_map
        pose_cov = linalg.symmetrize(closed @ pose_cov @ closed.T + spread.T @ spread)
        return (closed @ by_start, by_map, pose_cov), None

    kind = solved.cov.dtype
    start = jnp.eye(3, dtype=kind), jnp.zeros((3, wide), kind), jnp.zeros((3, 3), kind)
    (by_start, by_map, last_cov), _ = jax.lax.scan(forward, start, (system, solved.gains))
    rows = jnp.concatenate([by_start, by_map], axis=1) @ solved.cov
    pose = rows[:, :3] @ by_start.T + rows[:, 3:] @ by_map.T + last_cov
    cross = rows[:, 3:]
    return jnp.block([[linalg.symmetrize(pose), cross], [cross.T, solved.cov[3:, 3:]]])


def marginalize_oldest(
    prior: WindowPrior,
    system: LinearizedStep,
    steps: WindowSteps,
    at: WindowIterate,
    tag: Int[Array, "N"],
) -> WindowPrior:
    """The prior of the second pose, with the first motion and the first scan of the window in it.

    The Kalman filter of the linearized step about the iterate: prediction, correction by the whole
    scan, and new landmarks l = l̂ + B⁻¹ (b - A (x_1 - x̂_1) - v). They and x_1 get their points
    here. tag: of the map's slots. The prior itself if there is no first step.
    """
    step, oldest = jax.tree.map(lambda leaf: leaf[0], (system, steps))
    present, slot, used = oldest.present, oldest.slot, oldest.used
    joint, (capacity, size) = prior.joint, at.landmarks.shape
    # Prediction: x_1 = x̂_1 + F (x_0 - x̂_0) + G (η - η̄).
    mean = step.by_pose @ pose_difference(joint.pose, at.path[0]) - step.by_noise @ step.noise
    rows = step.by_pose @ joint.cov[:3]
    cov = joint.cov.at[:3].set(rows).at[:, :3].set(rows.T)
    corner = rows[:, :3] @ step.by_pose.T + step.by_noise @ step.by_noise.T
    cov = cov.at[:3, :3].set(linalg.symmetrize(corner))
    # Correction: b = A (x_1 - x̂_1) + B (l - l̂) + v.
    seen_before = used & joint.alive[slot]
    a, b, r = (
        jnp.where(seen_before.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0)
        for part in (step.pose_rows, step.landmark_rows, step.residual)
    )
    # B of the whole map: (M, Z, N, L) to (M Z, N L).
    wide = jnp.zeros((*b.shape[:2], capacity, size), b.dtype)
    by_map = wide.at[jnp.arange(len(slot)), :, slot].set(b).reshape(r.size, -1)
    jacobian = jnp.concatenate([a.reshape(r.size, 3), by_map], axis=1)
    off = jnp.where(joint.alive[:, None], joint.landmarks - at.landmarks, 0.0)
    deviation = jnp.concatenate([mean, off.reshape(-1)])
    seen = jacobian @ cov
    # The rows are in units of their noise: S = H P Hᵀ + 1.
    factor, _ = linalg.cholesky(seen @ jacobian.T + jnp.eye(r.size, dtype=r.dtype))
    white = linalg.solve_lower(factor, seen)
    innovation = linalg.solve_lower(factor, r.reshape(-1) - jacobian @ deviation)
    deviation = deviation + innovation @ white
    cov = linalg.symmetrize(cov - linalg.self_gram(white))
    pose = at.path[1] + deviation[:3]
    landmarks = at.landmarks + deviation[3:].reshape(capacity, size)
    after = joint._replace(
        pose=pose.at[2].set(wrap(pose[2])),
        landmarks=jnp.where(joint.alive[:, None], landmarks, 0.0),
        cov=cov,
    )
    # New landmarks.
    new = used & ~joint.alive[slot]
    landmark_rows = jnp.where(new[:, None, None], step.landmark_rows, jnp.eye(size, dtype=r.dtype))
    undo = jnp.linalg.inv(landmark_rows)
    start = at.landmarks[slot] + jnp.einsum(
        "mlz,mz->ml", undo, step.residual - step.pose_rows @ deviation[:3]
    )
    after = slots.scatter(
        after,
        slot,
        new,
        start,
        -undo @ step.pose_rows,
        # B⁻¹ v, of unit noise v.
        undo @ undo.swapaxes(1, 2),
        tag[slot],
    )
    points = at.path[1], jnp.where(joint.alive[:, None], prior.points[1], at.landmarks)
    moved = WindowPrior(after, points)
    chosen: WindowPrior = jax.tree.map(lambda a, b: jnp.where(present, a, b), moved, prior)
    return chosen
