"""The forward pass of a smoother: EKF-SLAM over the log, which stores its linearization points."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxslam._driver import check_run, run
from jaxslam.association._rules import Known
from jaxslam.core._numbers import as_array
from jaxslam.core._record import check_field, field, function_of, record, static
from jaxslam.core._validation import motion_model, sensor_model
from jaxslam.core.protocols import Associate, Component, Filter, Motion, Sensor, Wrapper
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Log, Scan, Trace
from jaxslam.core.validation import InvalidField, at_least, or_none, probability, refusals_of
from jaxslam.filters._ekf.ekf_slam import EkfSlam
from jaxslam.math._arrays import Number
from jaxslam.math._xla import hot_jit
from jaxslam.sensors._suite import Suite


class ForwardPass(NamedTuple):
    """A filtered log, and the points at which the filter linearized the models."""

    trace: Trace
    """the filter's own, its `final` a `slots.Joint`"""
    before: Float[Array, "T 3"]
    """the pose from which each motion was linearized"""
    predicted: Float[Array, "T 3"]
    """the pose after the motion, at which measurements of the map were linearized"""
    predicted_map: Float[Array, "T N L"]
    """the map before the scan"""
    corrected: Float[Array, "T 3"]
    """the pose after the scan, where new landmarks were linearized"""
    corrected_map: Float[Array, "T N L"]
    """the map after the scan"""


class _State(NamedTuple):
    """The filter's state, and the first linearization points of the current step."""

    joint: Joint
    before: Array
    predicted: Array
    predicted_map: Array


@record
class _Forward(Wrapper):
    """The EKF-SLAM of a forward pass, which keeps its linearization points; state `_State`."""

    filter: Filter

    def init(self, pose: Array, pose_cov: Array) -> _State:
        joint = self.filter.init(pose, pose_cov)
        return _State(joint, pose, pose, joint.landmarks)

    def predict(self, state: _State, u: Array, key: Array) -> _State:
        joint = self.filter.predict(state.joint, u, key)
        return _State(joint, state.joint.pose, joint.pose, joint.landmarks)

    def update(self, state: _State, scan: Scan, key: Array) -> tuple[_State, Info]:
        joint, info = self.filter.update(state.joint, scan, key)
        return state._replace(joint=joint), info

    def estimate(self, state: _State) -> Estimate:
        return self.filter.estimate(state.joint)


def joint_ekf(of: Any) -> EkfSlam:
    """The EKF-SLAM with joint correction in the Euclidean chart of an estimator's fields."""
    return EkfSlam(
        of.motion,
        of.sensor,
        of.capacity,
        associate=of.associate,
        correction="joint",
        gate=of.gate,
        births=of.births,
    )


@record
class LogEstimator(Component):
    """The base of estimators of a whole log: models, start, and the EKF-SLAM of the forward pass.

    A subclass is a record that defines `solve`. Called with (log, key) it gives a `Trace`. Raises
    ValueError as `EkfSlam` does, and for sensors that it does not support: a suite, landmarks that
    become points, or landmarks with parameters that are exact given the pose (the anchor of a ray);
    and, when called, as `run` does.
    """

    motion: Motion = field(check=motion_model)
    sensor: Sensor = field(check=sensor_model)
    """the models; Jacobians come from `jax.jacfwd`"""
    capacity: int = static(check=at_least(1))
    """landmark slots N"""
    pose: ArrayLike = dataclasses.field()
    """(3,) of the robot before the first control"""
    pose_cov: ArrayLike = dataclasses.field()
    """(3, 3)"""
    _: dataclasses.KW_ONLY
    associate: Associate = field(default=Known(), check=function_of("prediction", "scan"))
    """See `EkfSlam.associate`."""
    gate: Number | None = field(default=None, check=or_none(probability))
    """See `EkfSlam.gate`."""
    births: int | None = static(default=None, check=or_none(at_least(1)))
    """See `EkfSlam.births`."""

    def __post_init__(self) -> None:
        sensor = self.sensor
        if isinstance(sensor, Suite) or sensor.reduced is not None:
            raise InvalidField(
                "sensor",
                "expected one of landmarks, not a suite or landmarks that are converted to points, "
                f"got {sensor.name}",
            )
        if len(sensor.landmark) > len(sensor.measurements) + sensor.free.mean.shape[0]:
            raise InvalidField(
                "sensor",
                "expected landmarks that measurement and prior determine, got "
                f"{sensor.landmark} of {sensor.name}",
            )
        for start in ("pose", "pose_cov"):
            check_field(self, start, as_array)
        self._check(LogEstimator, {"solve": "log, key"})

    def solve(self, log: Log, key: Array) -> Trace:
        """The estimates of a checked log."""
        raise NotImplementedError

    def __call__(self, log: Log, key: Array) -> Trace:
        with refusals_of(self.name):
            check_run(self._filter, log, self.pose, self.pose_cov)
        return _solve(self, log, key)

    @property
    def _filter(self) -> Filter:
        return _Forward(joint_ekf(self))

    def _forward(self, log: Log, key: Array) -> ForwardPass:
        """The forward pass; arguments and errors as in `run`."""

        def linearized_at(state: _State) -> tuple[Array, ...]:
            joint = state.joint
            return state.before, state.predicted, state.predicted_map, joint.pose, joint.landmarks

        trace = run(self._filter, log, self.pose, self.pose_cov, key, probe=linearized_at)
        return ForwardPass(trace._replace(final=trace.final.joint, probe=None), *trace.probe)


@hot_jit
def _solve(estimator: LogEstimator, log: Log, key: Array) -> Trace:
    return estimator.solve(log, key)


def log_in_one_dtype(log: Log) -> Log:
    """The log as arrays, controls and measurements in the wider dtype of the two, as in `run`."""
    log = jax.tree.map(jnp.asarray, log)
    dtype = jnp.result_type(log.control, log.scan.z)
    return Log(log.control.astype(dtype), log.scan._replace(z=log.scan.z.astype(dtype)))
