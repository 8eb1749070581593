"""Cramér-Rao bounds on estimators that are unbiased given the truth, and on all estimators."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam._driver import run
from jaxslam.consistency._run_scores import snapshot_steps
from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Estimate, Log, Truth
from jaxslam.core.validation import InvalidField, refusals_of
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.linearize import _first_order as first_order
from jaxslam.linearize._first_order import with_lever_arm
from jaxslam.linearize._other_points import AtTruth
from jaxslam.math._linalg import root_psd
from jaxslam.sensors._suite import Suite, of_robot
from jaxslam.simulation._recorded import RecordedWorld
from jaxslam.simulation._worlds import Scenario, World


def conditional_bound(scenario: World, truth: Truth, log: Log, key: Array) -> Estimate:
    """The Cramér-Rao bound given a true trajectory, as the covariances of an `Estimate` (T,).

    Of a motion model with further numbers in its state, `further_cov` bounds theirs.

    It bounds the covariance of estimators that are unbiased *given that trajectory and map*; the
    average over runs of such estimators' mean square errors lies above the average of the bounds. A
    Bayesian estimator is biased given the truth, towards its prior, and may lie below: by Jensen's
    inequality this average of inverses lies above the inverse of the average, which is the
    `posterior_bound`. The two agree where the information hardly varies between the runs.

    Tichavský, Muravchik & Nehorai (IEEE Trans. Signal Processing 46(5), 1998) give the recursion
    J_{k+1} = D22 - D21 (J_k + D11)⁻¹ D12, D11 = FᵀQ⁻¹F, D12 = -FᵀQ⁻¹, D22 = Q⁻¹ + HᵀR⁻¹H, here with
    the Jacobians of one trajectory in place of their means. Its inverse is the covariance of the
    Kalman filter of that linear system, which also exists for a singular Q or P0; so this runs the
    ideal EKF without gate and without a quota of new landmarks. The noise of a measurement is what
    the sensor states for its prediction.
    """
    options = {**scenario.filter_options, "gate": None, "births": None}
    capacity = truth.landmarks.shape[0]
    ideal = EkfSlam(scenario.motion, scenario.sensor, capacity, **options, linearize=AtTruth(truth))
    return run(ideal, log, scenario.pose, scenario.pose_cov, key).estimate


def posterior_bound(
    scenario: World, truth: Truth, log: Log, steps: Sequence[int] | None = None
) -> tuple[Int[np.ndarray, "K"], Float[np.ndarray, "K 3 3"]]:
    """Steps, and at each of them the bound on the mean square pose error of all estimators.

    The posterior (van Trees) bound: information is averaged over the worlds and then inverted. The
    recursion over states needs Q⁻¹, which the noise of a robot seldom has; so the bound is taken
    over the random variables p = (ξ, ω_1 … ω_t, landmarks) with ξ, ω ~ N(0, 1), x_0 = pose + √P0 ξ
    and x_t = f(x_{t-1}, u_t, √Q ω_t):

        J_t = diag(1, …, 1, 0, …, 0) + E Σ_{s<=t} (∂h_s/∂p)ᵀ R⁻¹ (∂h_s/∂p),
        E (x̂_t - x_t)(x̂_t - x_t)ᵀ >= A J_t⁻¹ Aᵀ,     A = E ∂x_t/∂p,

    E over the worlds given, whose number should be large enough for an average. The landmarks are
    the same unknowns in every run, without a prior: the bound holds for estimators that do not know
    the map beforehand and are unbiased in it (a hybrid bound: Rockah & Schultheiss, IEEE Trans.
    ASSP 35(3), 1987; van Trees, "Detection, Estimation, and Modulation Theory I", 1968, 2.4.3).
    Jacobians by the noise are taken at ω = 0, and Q and R are what the models state at the truth
    and for the exact measurement; what could be learnt of the state from their dependence on it, or
    from which landmarks are in view, is not counted. Most of the time goes into the eigenvalues of
    K matrices of size 3 + W T + L N.

    Args:
        truth, log: of `simulate`, with a leading axis over runs; identities known.
        steps: counted from 0; default the steps of the snapshots.
    Raises:
        ValueError: on a world of spurious data or of several robots, arrays without runs, or a
            measurement noise that is singular.
    """
    is_single = isinstance(scenario, Scenario | RecordedWorld)
    with refusals_of("posterior_bound"):
        if not is_single or scenario.spurious is not None:
            reason = "expected one of a single robot without spurious measurements"
            raise InvalidField("scenario", reason)
        if np.ndim(truth.pose) != 3 or np.shape(log.control)[:2] != np.shape(truth.pose)[:2]:
            raise InvalidField("truth, log", "expected a leading axis over runs")
        count, total = truth.pose.shape[:2]
        at = snapshot_steps(total) if steps is None else np.asarray(steps, int)
        if at.size == 0 or at.min() < 0 or at.max() >= total:
            raise InvalidField("steps", f"expected numbers from 0 to {total - 1}, got {steps}")
    runs = jax.device_get(jax.jit(jax.vmap(partial(jacobians_at_truth, scenario)))(truth, log))
    start = np.asarray(jax.jit(root_psd)(jnp.asarray(scenario.pose_cov, truth.pose.dtype)))
    by_p: np.ndarray = np.zeros(())
    information: np.ndarray = np.zeros(())
    for i in range(count):
        rows = list(_by_parameters(jax.tree.map(lambda leaf, i=i: leaf[i], runs), start, at))
        by_p = by_p + np.stack([a for a, _ in rows]) / count
        information = information + np.stack([gained for _, gained in rows]) / count
    random = len(start) + total * runs.by_noise.shape[3]
    prior = np.diag((np.arange(information.shape[1]) < random).astype(float))
    bounds = [_invert(a[:3], prior + j) for a, j in zip(by_p, information, strict=True)]
    return at, np.stack(bounds)


def van_trees(
    target_jacobians: Float[np.ndarray, "draws K P"],
    jacobians: Float[np.ndarray, "draws M P"],
    noise_covs: np.ndarray,
    prior: Float[np.ndarray, "P P"],
) -> Float[np.ndarray, "K K"]:
    """The posterior Cramér-Rao bound (K, K) on the mean square error of g(p) ∈ Rᴷ, z = h(p) + v.

    E ∂g/∂p (prior + E (∂h/∂p)ᵀ R⁻¹ (∂h/∂p))⁻¹ (E ∂g/∂p)ᵀ, E over draws of p (van Trees 1968, 2.4).

    Args:
        target_jacobians: ∂g/∂p of each draw. jacobians: ∂h/∂p.
        noise_covs: R (M, M), or (draws, M, M).
        prior: information on p: P0⁻¹ of a normal prior, 0 without a prior. A direction that
            nothing determines is left out, and must not matter to g.
    """
    scaled = np.linalg.solve(noise_covs, jacobians)
    gained = (np.swapaxes(jacobians, 1, 2) @ scaled).mean(axis=0)
    return _invert(np.mean(target_jacobians, axis=0), prior + gained)


class SensorJacobians(NamedTuple):
    """The Jacobians of one sensor's measurements in a run, at the truth."""

    by_pose: Float[Array, "T M Z R"]
    by_landmark: Float[Array, "T M Z L"]
    noise_cov: Float[Array, "T M Z Z"]
    tag: Int[Array, "T M"]
    """row of the landmark"""
    valid: Bool[Array, "T M"]
    """mask of the measurements"""


class RunJacobians(NamedTuple):
    """The Jacobians of the models along the true path of one run."""

    by_pose: Float[Array, "T R R"]
    """∂f/∂x of the motion"""
    by_noise: Float[Array, "T R W"]
    """∂f/∂w √Q of the motion"""
    sensors: list[SensorJacobians]
    landmarks: Float[Array, "N L"]


def jacobians_at_truth(scenario: World, truth: Truth, log: Log) -> RunJacobians:
    """The Jacobians of the models along the true path of one run; traceable, for `vmap` over runs.

    For the world of one robot, nothing spurious, tags known.
    """
    motion, dtype = scenario.motion, truth.pose.dtype
    path, landmarks = jnp.asarray(truth.robot), jnp.asarray(truth.landmarks)
    old = jnp.concatenate([truth.start[None], path[:-1]])
    still = jnp.zeros(len(motion.noises), dtype)

    def motion_jacobians(old: Array, new: Array, u: Array) -> tuple[Array, Array]:
        by_pose, by_noise = first_order.motion_jacobians(motion, old, u)
        ahead = motion.step(old, u, still)
        root = root_psd(motion.noise_cov(old, u))
        return with_lever_arm(by_pose, new[:2] - ahead[:2]), by_noise @ root

    by_pose, by_noise = jax.vmap(motion_jacobians)(old, path, log.control)
    sensor = scenario.sensor
    parts = (
        [(p.sensor, p.places) for p in sensor.parts]
        if isinstance(sensor, Suite)
        else [(sensor, log.scan.tag.shape[1])]
    )
    sensors: list[SensorJacobians] = []
    first = 0
    for part, places in parts:
        model = of_robot(part, motion.state)

        def observe_jacobians(
            pose: Array, tag: Array, model: Sensor = model
        ) -> tuple[Array, Array, Array]:
            landmark = landmarks[tag][: len(model.landmark)]
            noise = model.noise_cov(model.observe(pose, landmark))
            return *first_order.observe_jacobians(model, pose, landmark), noise

        tag, valid = (leaf[:, first : first + places] for leaf in log.scan[1:])
        tag = jnp.maximum(tag, 0)
        jacobians = jax.vmap(jax.vmap(observe_jacobians, (None, 0)))(path, tag)
        sensors.append(SensorJacobians(*jacobians, tag, valid))
        first += places
    return RunJacobians(by_pose, by_noise, sensors, landmarks)


def final_covariance(
    jacobians: RunJacobians, pose_cov: Float[np.ndarray, "R R"]
) -> Float[np.ndarray, "3 3"]:
    """The covariance of the last pose in `conditional_bound`, of one run, by NumPy.

    The Kalman filter of the linear system that the Jacobians make. A landmark begins with its first
    measurement, where that determines it, and otherwise with a deviation of 100 times the map's
    reach. A billionth of the reach is added to the noise of measurements, which may be none.
    """
    (count, size), n = jacobians.landmarks.shape, len(pose_cov)
    # Deviations relative to the map's reach: large enough for "unknown" (100), and small enough
    # that a measurement without noise has an innovation covariance with an inverse (1e-9).
    reach = 1.0 + float(np.max(np.abs(jacobians.landmarks), initial=0.0))
    cov = np.zeros((n + count * size,) * 2)
    cov[:n, :n] = pose_cov
    in_map = np.zeros(count, bool)
    for t in range(len(jacobians.by_pose)):
        cov[:n] = jacobians.by_pose[t] @ cov[:n]
        cov[:, :n] = cov[:, :n] @ jacobians.by_pose[t].T
        cov[:n, :n] += jacobians.by_noise[t] @ jacobians.by_noise[t].T
        for seen in jacobians.sensors:
            for i in np.flatnonzero(seen.valid[t]):
                by_pose, by_landmark = seen.by_pose[t, i], seen.by_landmark[t, i]
                noise = seen.noise_cov[t, i] + (1e-9 * reach) ** 2 * np.eye(len(by_pose))
                begin = n + int(seen.tag[t, i]) * size
                block = slice(begin, begin + by_landmark.shape[1])
                if by_landmark.shape[1] and not in_map[seen.tag[t, i]]:
                    in_map[seen.tag[t, i]] = True
                    # With a larger condition number the landmark is not determined: 6 of 16 digits
                    # of its position would be lost, and 12 of its covariance.
                    if by_landmark.shape == (size, size) and np.linalg.cond(by_landmark) < 1e6:
                        by = np.linalg.inv(by_landmark)
                        cov[block] = -by @ by_pose @ cov[:n]
                        cov[:, block] = cov[block].T
                        cov[block, block] = by @ (by_pose @ cov[:n, :n] @ by_pose.T + noise) @ by.T
                        continue
                    parameters = slice(begin, begin + size)
                    cov[parameters, parameters] = (100 * reach) ** 2 * np.eye(size)
                cross = by_pose @ cov[:n] + by_landmark @ cov[block]
                innovation = cross[:, :n] @ by_pose.T + cross[:, block] @ by_landmark.T + noise
                cov -= cross.T @ np.linalg.solve(innovation, cross)
        cov = (cov + cov.T) / 2
    return cov[:3, :3]


def _by_parameters(
    run: RunJacobians, start: Float[np.ndarray, "R R"], at: Int[np.ndarray, "K"]
) -> Iterator[tuple[Float[np.ndarray, "R P"], Float[np.ndarray, "P P"]]]:
    """The derivative ∂x_t/∂p, and the information on p of the scans until then, at steps `at`."""
    steps, n, width = run.by_noise.shape
    count, size = run.landmarks.shape
    map_at = n + steps * width
    by_p = np.zeros((n, map_at + count * size))
    by_p[:, :n] = start
    information = np.zeros((by_p.shape[1],) * 2)
    kept = {}
    white = [_whiten(sensor) for sensor in run.sensors]
    for t in range(steps):
        by_p = np.asarray(run.by_pose[t]) @ by_p
        by_p[:, n + t * width : n + (t + 1) * width] = run.by_noise[t]
        for (by_pose, by_landmark), sensor in zip(white, run.sensors, strict=True):
            rows = by_pose[t] @ by_p
            for i, tag in enumerate(sensor.tag[t]):
                begin = map_at + int(tag) * size
                rows[i, :, begin : begin + by_landmark.shape[3]] += by_landmark[t, i]
            rows = rows.reshape(-1, by_p.shape[1])
            information += rows.T @ rows
        if t in at:
            kept[t] = by_p.copy(), information.copy()
    return iter([kept[t] for t in at])


def _whiten(sensor: SensorJacobians) -> list[np.ndarray]:
    """The whitened Jacobians R^{-1/2} H by pose and landmark; zero where nothing was measured."""
    valid = sensor.valid[:, :, None, None]
    noise = np.where(valid, sensor.noise_cov, np.eye(sensor.noise_cov.shape[2]))
    try:
        factor = np.linalg.cholesky(noise)
    except np.linalg.LinAlgError:
        raise ValueError(
            "posterior_bound: a covariance of measurement noise is not positive definite"
        ) from None
    return [np.where(valid, np.linalg.solve(factor, by), 0.0) for by in sensor[:2]]


def _invert(
    jacobian: Float[np.ndarray, "K P"], information: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "K K"]:
    """A J⁺ Aᵀ, J scaled to a unit diagonal, a direction of no information left out."""
    size = np.sqrt(np.diagonal(information))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    values, vectors = np.linalg.eigh(information * unit[:, None] * unit)
    positive = values > len(values) * np.finfo(float).eps * values[-1]
    root = (jacobian * unit) @ vectors[:, positive] / np.sqrt(values[positive])
    bound: np.ndarray = root @ root.T
    return bound
