"""The forward pass of a smoother: EKF-SLAM over the log, which stores its linearization points."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxslam import programs, validation
from jaxslam.filters.ekf.ekf_slam import ekf_slam
from jaxslam.protocols import Associate, Estimator, Filter, Motion, Sensor
from jaxslam.run import check_run, run
from jaxslam.sensors.suite import Suite
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Log, Scan, Trace


class ForwardPass(NamedTuple):
    """A filtered log, and the points at which the filter linearized the models."""

    trace: Trace
    """the filter's own, its `final` a `slots.Joint`"""
    before: Float[Array, "T 3"]
    """the pose from which each motion was linearized"""
    predicted: Float[Array, "T 3"]
    """the pose after it, at which known landmarks were linearized"""
    predicted_map: Float[Array, "T N L"]
    """the map there"""
    corrected: Float[Array, "T 3"]
    """the pose after the scan, where new landmarks were linearized"""
    corrected_map: Float[Array, "T N L"]


class _State(NamedTuple):
    """The filter's state, and the first linearization points of the current step."""

    joint: Joint
    before: Array
    predicted: Array
    predicted_map: Array


def forward_filter(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    name: str,
    associate: Associate | None = None,
    gate: float | None = None,
    births: int | None = None,
) -> Filter:
    """The EKF-SLAM of a forward pass: joint correction, Euclidean chart, state `_State`.

    Raises ValueError as `ekf_slam` does, and for sensors that the smoother does not support: a
    suite, landmarks that become points, or landmarks with parameters that are exact given the pose
    (the anchor of a ray).
    """
    validation.check_models(name, motion, sensor)
    validation.check_parts(name, associate=associate)
    if isinstance(sensor, Suite) or sensor.reduced is not None:
        raise ValueError(
            f"{name}: expected one sensor of landmarks, not a suite or landmarks that are "
            f"converted to points, got {sensor.name}"
        )
    if len(sensor.landmark) > len(sensor.measurements) + sensor.free.mean.shape[0]:
        raise ValueError(
            f"{name}: expected landmarks that measurement and prior determine, got "
            f"{sensor.landmark} of {sensor.name}"
        )
    ekf = ekf_slam(
        motion, sensor, capacity, associate=associate, update="joint", gate=gate, births=births
    )

    def init(pose: Array, pose_cov: Array) -> _State:
        joint = ekf.init(pose, pose_cov)
        return _State(joint, pose, pose, joint.landmarks)

    def predict(state: _State, u: Array, key: Array) -> _State:
        joint = ekf.predict(state.joint, u, key)
        return _State(joint, state.joint.pose, joint.pose, joint.landmarks)

    def update(state: _State, scan: Scan, key: Array) -> tuple[_State, Info]:
        joint, info = ekf.update(state.joint, scan, key)
        return state._replace(joint=joint), info

    def estimate(state: _State) -> Estimate:
        return ekf.estimate(state.joint)

    return dataclasses.replace(
        ekf, name=name, init=init, predict=predict, update=update, estimate=estimate
    )


def run_forward(
    filter: Filter, log: Log, pose: ArrayLike, pose_cov: ArrayLike, key: Array
) -> ForwardPass:
    """The forward pass of a `forward_filter`; arguments and errors are those of `run`."""

    def linearized_at(state: _State) -> tuple[Array, ...]:
        joint = state.joint
        return state.before, state.predicted, state.predicted_map, joint.pose, joint.landmarks

    trace = run(filter, log, pose, pose_cov, key, probe=linearized_at)
    return ForwardPass(trace._replace(final=trace.final.joint, probe=None), *trace.probe)


def compiled_once(
    filter: Filter, pose: ArrayLike, pose_cov: ArrayLike, solve: Estimator
) -> Estimator:
    """The estimator that checks its arguments as `run` does, under its own name, and calls `solve`,
    compiled as `run` is."""

    def estimator(log: Log, key: Array) -> Trace:
        check_run(filter.name, filter, log, pose, pose_cov)
        return programs.call(solve, (), log, key)

    return estimator


def log_in_one_dtype(log: Log) -> Log:
    """The log as arrays, controls and measurements in the wider dtype of the two, as in `run`."""
    log = jax.tree.map(jnp.asarray, log)
    dtype = jnp.result_type(log.control, log.scan.z)
    return Log(log.control.astype(dtype), log.scan._replace(z=log.scan.z.astype(dtype)))
