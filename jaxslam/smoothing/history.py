"""What a forward pass of EKF-SLAM saw, and where it linearized: the chain of its own posterior."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxslam import derivatives, programs, validation
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.protocols import Associate, Estimator, Filter, Motion, Sensor
from jaxslam.run import check_run, run
from jaxslam.sensors.suite import Suite
from jaxslam.slots import Joint
from jaxslam.smoothing.chain import Chain, Start, Step
from jaxslam.types import Estimate, Info, Log, Scan, Status, Trace

Array = jax.Array


class History(NamedTuple):
    """A filtered log."""

    trace: Trace
    """the filter's own, its `final` a `slots.Joint`"""
    before: Array
    """(T, 3) pose from which each motion was linearized"""
    ahead: Array
    """(T, 3) pose to which it led, where known landmarks were linearized"""
    map_ahead: Array
    """(T, N, L) the map there"""
    after: Array
    """(T, 3) pose after the scan, where new landmarks were linearized"""
    map_after: Array
    """(T, N, L)"""


class _Kept(NamedTuple):
    joint: Joint
    before: Array
    ahead: Array
    map_ahead: Array


def filter_of(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    name: str,
    associate: Associate | None = None,
    gate: float | None = None,
    births: int | None = None,
) -> Filter:
    """The EKF-SLAM that goes ahead of a smoother, its state a `_Kept`: joint correction, Euclidean.

    Raises ValueError as `ekf_slam` does, and for sensors that a smoother has no chain for: a suite,
    landmarks that turn into points, or landmarks whose birth makes a part of them exact (the anchor
    of a ray, where the robot was).
    """
    validation.check_models(name, motion, sensor)
    validation.check_parts(name, associate=associate)
    if isinstance(sensor, Suite) or sensor.reduced is not None:
        raise ValueError(
            f"{name}: expected one sensor of landmarks that stay what they are, not a suite or "
            f"landmarks that turn into points, got {sensor.name}"
        )
    if len(sensor.landmark) > len(sensor.measurements) + sensor.free.mean.shape[0]:
        raise ValueError(
            f"{name}: the landmarks of {sensor.name} hold more than what it measures and has a "
            "prior of; to a smoother the rest would be exact"
        )
    ekf = ekf_slam(
        motion, sensor, capacity, associate=associate, update="joint", gate=gate, births=births
    )

    def init(pose: Array, pose_cov: Array) -> _Kept:
        joint = ekf.init(pose, pose_cov)
        return _Kept(joint, pose, pose, joint.landmarks)

    def predict(state: _Kept, u: Array, key: Array) -> _Kept:
        joint = ekf.predict(state.joint, u, key)
        return _Kept(joint, state.joint.pose, joint.pose, joint.landmarks)

    def update(state: _Kept, scan: Scan, key: Array) -> tuple[_Kept, Info]:
        joint, info = ekf.update(state.joint, scan, key)
        return state._replace(joint=joint), info

    def estimate(state: _Kept) -> Estimate:
        return ekf.estimate(state.joint)

    return dataclasses.replace(
        ekf, name=name, init=init, predict=predict, update=update, estimate=estimate
    )


def compiled_once(
    filter: Filter, pose: ArrayLike, pose_cov: ArrayLike, solve: Estimator
) -> Estimator:
    """The estimator that refuses what `run` refuses, by its own name, and calls `solve`, compiled
    as `run` is."""

    def estimator(log: Log, key: Array) -> Trace:
        check_run(filter.name, filter, log, pose, pose_cov)
        return programs.call(solve, (), log, key)

    return estimator


def filtered(filter: Filter, log: Log, pose: ArrayLike, pose_cov: ArrayLike, key: Array) -> History:
    """Run a filter of `filter_of`; arguments and errors are those of `run`."""

    def seen(state: _Kept) -> Any:
        return state.before, state.ahead, state.map_ahead, state.joint.pose, state.joint.landmarks

    trace = run(filter, log, pose, pose_cov, key, probe=seen)
    return History(trace._replace(final=trace.final.joint, probe=None), *trace.probe)


def roots_of(motion: Motion, history: History, control: Array) -> Array:
    """(T, W, W) of the noise covariances of the motions, where the filter took them."""
    cov = jax.vmap(motion.noise_cov)(history.before, control)
    return jax.vmap(linalg.root_psd)(cov)


def start_of(pose_cov: Array) -> Start:
    """A start where the prior has its mean."""
    return Start(linalg.root_psd(pose_cov), jnp.zeros(3, pose_cov.dtype))


def chain_of(
    motion: Motion, sensor: Sensor, history: History, log: Log, pose_cov: Array, roots: Array
) -> tuple[Chain, Array]:
    """The filter's own linear system about its path and final map; and which places it uses.

    The Kalman filter of this system is the EKF: its posterior of the last pose and the map is the
    filter's, its posterior of the poses before is the fixed-interval smoother's. A landmark is born
    by l = g(pose, z, s̄) + G_z v + G_s e, a measurement of itself and of the pose; before, nothing
    is known of it. Places (T, M) are used where the filter fused them or started a landmark, and
    their noise is regular.
    """
    size_l, size_z = len(sensor.landmark), len(sensor.measurements)
    rows = max(size_l, size_z)
    info, final = history.trace.info, history.trace.final
    fused, born = info.status == Status.FUSED, info.status == Status.BORN
    size_w = len(motion.noises)

    def moved(
        before: Array, ahead: Array, after: Array, u: Array, root: Array
    ) -> tuple[Array, Array, Array]:
        by_pose, by_noise = derivatives.motion_jacobians(motion, before, u)
        return by_pose, by_noise @ root, difference(ahead, after)

    by_pose, by_noise, drift = jax.vmap(moved)(
        history.before, history.ahead, history.after, log.control, roots
    )

    def fuse(z: Array, pose: Array, landmark: Array) -> tuple[Array, Array, Array, Array]:
        return whitened_rows(sensor, z, pose, landmark)

    def bear(z: Array, pose: Array) -> tuple[Array, Array, Array, Array]:
        mean, cov_s = (jnp.asarray(part, z.dtype) for part in sensor.free)
        by_pose, by_z, by_s = derivatives.invert_jacobians(sensor, pose, z, mean)
        own = by_z @ sensor.noise_cov(z) @ by_z.T + by_s @ cov_s @ by_s.T
        factor, positive = linalg.cholesky(own)
        a = linalg.solve_lower(factor, -by_pose)
        b = linalg.solve_lower(factor, jnp.eye(size_l, dtype=z.dtype))
        return a, b, jnp.zeros(size_l, z.dtype), positive

    def place(
        z: Array, slot: Array, fused: Array, born: Array, row: Any
    ) -> tuple[Array, Array, Array, Array]:
        ahead, map_ahead, after, map_after = row

        def wide(part: Array) -> Array:
            return jnp.pad(part, [(0, rows - part.shape[0])] + [(0, 0)] * (part.ndim - 1))

        a, b, r, positive = fuse(z, ahead, map_ahead[slot])
        at_pose, at_landmark = ahead, map_ahead[slot]
        parts = tuple(wide(part) for part in (a, b, r))
        if size_l > 0:
            *others, sound = bear(z, after)
            parts = tuple(
                jnp.where(born, wide(other), part)
                for other, part in zip(others, parts, strict=True)
            )
            positive = jnp.where(born, sound, positive)
            at_pose = jnp.where(born, after, at_pose)
            at_landmark = jnp.where(born, map_after[slot], at_landmark)
        use = (fused | born) & positive
        a, b, r = (jnp.where(use, part, jnp.zeros_like(part)) for part in parts)
        # From where it was linearized to the reference.
        r = r - a @ difference(after, at_pose) - b @ (final.landmarks[slot] - at_landmark)
        return a, b, r, use

    z = jnp.where(log.scan.valid[:, :, None], log.scan.z, 0.0)
    slot = jnp.maximum(info.slot, 0)
    at = history.ahead, history.map_ahead, history.after, history.map_after
    a, b, r, used = jax.vmap(jax.vmap(place, (0, 0, 0, 0, None)))(z, slot, fused, born, at)
    steps = Step(by_pose, by_noise, drift, jnp.zeros((len(drift), size_w), z.dtype), slot, a, b, r)
    return Chain(start_of(pose_cov), steps), used


def whitened_rows(
    sensor: Sensor, z: Array, pose: Array, landmark: Array
) -> tuple[Array, Array, Array, Array]:
    """R^{-1/2} times H_pose (Z, 3), H_l (Z, L) and z ⊖ h (Z,); and whether R is regular."""
    by_pose, by_landmark = derivatives.observe_jacobians(sensor, pose, landmark)
    off = sensor.residual(z, sensor.observe(pose, landmark))
    factor, positive = linalg.cholesky(sensor.noise_cov(z))
    a, b, r = (linalg.solve_lower(factor, part) for part in (by_pose, by_landmark, off))
    return a, b, r, positive


def difference(a: Array, b: Array) -> Array:
    """a - b of two poses (3,) by coordinates, the angle wrapped."""
    off = a - b
    return off.at[2].set(wrap(off[2]))
