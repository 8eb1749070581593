"""EKF localization: the robot's pose in a known map."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PyTree
from numpy.typing import ArrayLike

from jaxslam.association._rules import Known
from jaxslam.charts import Euclidean
from jaxslam.core import _validation as validation
from jaxslam.core import slots
from jaxslam.core._numbers import held_array, is_concrete
from jaxslam.core._record import hold_function, record, set_field, static
from jaxslam.core.protocols import (
    NOTHING_FREE,
    Associate,
    Association,
    Basis,
    Chart,
    Filter,
    LinearizationPoint,
    Linearizer,
    Motion,
    Prediction,
    Sensor,
)
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, Scan
from jaxslam.filters._ekf.ekf_settings import (
    CorrectionOrder,
    Covariance,
    EkfSettings,
    check_covariance_form,
    check_ekf_options,
    check_iterations,
)
from jaxslam.filters._ekf.predict import propagate
from jaxslam.filters._ekf.scan import SensorStage, update_by_scan
from jaxslam.linearize._first_order import AtEstimate
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.sensors._suite import Suite, Wrapped

Array = jax.Array


@record
class Localization(Filter):
    """Extended Kalman filter of the pose in a known map without errors (Williams, localization).

    The equations of EKF-SLAM with P_ll = 0: z = h(x, l_j) with H by the pose only, P (3, 3). A step
    costs O(M), plus the search for tags among N (0.09 ms a step with 10,000); association other
    than by tags compares all landmarks. With a `sensors.Suite`, absolute sensors (compass, position
    fix) correct in the same update.

    The state is a `slots.Joint` whose landmarks have no parameters. A measurement without a
    landmark in the map is `Status.UNMATCHED`.

    Raises ValueError on a map that is not finite (N, L), tags that are not N different numbers from
    0 on, a chart or linearizer that needs the landmarks' errors, and as `EkfSlam` does.
    """

    motion: Motion
    sensor: Sensor
    landmarks: ArrayLike
    """(N, L) the map, in the sensor's parameters"""
    _: dataclasses.KW_ONLY
    tags: tuple[int, ...] | None = static(default=None)
    """N different ones, in any form, as of a map of some landmarks; default the row numbers"""
    chart: Chart = Euclidean()
    """the error coordinates of P; its pose part"""
    linearize: Linearizer = AtEstimate()
    """one without a memory of landmarks (AtEstimate, Unscented)"""
    associate: Associate = Known()
    correction: CorrectionOrder = static(default="sequential")
    gate: Number | None = None
    iterations: int = static(default=1)
    """these four as for `EkfSlam`"""
    covariance: Covariance = static(default="plain")
    """"plain" or "joseph", as there"""

    def __post_init__(self) -> None:
        name, linearize = "Localization", self.linearize
        validation.check_models(name, self.motion, self.sensor)
        validation.check_parts(name, self.chart, linearize, self.associate)
        hold_function(self, "associate", "prediction, scan")
        hold_map(self)
        check_ekf_options(name, 1, self.correction, self.gate, self.iterations, None)
        check_covariance_form(name, self.covariance, ("plain", "joseph"))
        if linearize.own_landmarks:
            raise ValueError(
                f"{name}: the linearizer {linearize.name} is for estimated maps, not for a known "
                "one"
            )
        check_iterations(name, linearize, self.iterations)
        super().__post_init__()

    @property
    def map_size(self) -> int | None:  # type: ignore[override]
        is_whole = self.tags is None and self.sensor.landmark
        return np.shape(self.landmarks)[0] if is_whole else None

    def init(self, pose: Array, pose_cov: Array) -> Joint:
        chart, capacity = _OfPose(self.chart), np.shape(self.landmarks)[0]
        ground = jnp.zeros((capacity, 0), pose.dtype)
        if chart.basis is not None:
            undo = linalg.inverse(chart.basis(pose, ground[0]).pose)
            pose_cov = undo @ pose_cov @ undo.T
        joint = slots.empty(pose, pose_cov, capacity, 0, self.linearize.init(pose, ground))
        return joint._replace(alive=jnp.ones(capacity, bool), tag=map_tags(self))

    def predict(self, state: Joint, u: Array, key: Array) -> Joint:
        return propagate(state, u, self.motion, self._settings(self.sensor))[0]

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        stages = [SensorStage(None, self._settings(self.sensor))]
        if isinstance(self.sensor, Suite):
            stages = [
                SensorStage(
                    part.places, None if part.sees == "robots" else self._settings(part.sensor)
                )
                for part in self.sensor.parts
            ]
        return update_by_scan(state, scan, stages)[:2]

    def estimate(self, state: Joint) -> Estimate:
        cov, chart = state.cov, _OfPose(self.chart)
        if chart.basis is not None:
            basis = chart.basis(state.pose, state.landmarks[0]).pose
            cov = basis @ cov @ basis.T
        points = jnp.asarray(self.landmarks, state.pose.dtype)
        return Estimate(
            pose=state.pose,
            pose_cov=cov,
            points=jax.vmap(self.sensor.position)(points),
            point_covs=jnp.zeros((len(points), 2, 2), cov.dtype),
            alive=state.alive,
            tag=state.tag,
        )

    def _settings(self, sensor: Sensor) -> EkfSettings:
        """The settings for one sensor of known landmarks, or for an absolute sensor."""
        absolute = not sensor.landmark
        linearize = self.linearize if absolute else _OnMap(self.linearize, self.landmarks)
        return EkfSettings(
            sensor=_OfRobot(sensor),
            chart=_OfPose(self.chart),
            linearize=linearize,
            associate=_NeverNew(self.associate),
            correction=self.correction,
            gate=self.gate,
            iterations=self.iterations,
            covariance=self.covariance,
            births=0,
            absolute=absolute,
        )


@record
class _OnMap(Linearizer):
    """A linearizer with the landmark of a slot as a constant of the sensor."""

    linearize: Linearizer
    points: PyTree

    def init(self, pose: Array, landmarks: Array) -> PyTree:
        return self.linearize.init(pose, landmarks)

    def motion(
        self, motion: Motion, u: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, PyTree]:
        return self.linearize.motion(motion, u, point)

    def observe(
        self, sensor: Sensor, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        landmark = jnp.asarray(self.points, point.pose.dtype)[point.slot]
        return self.linearize.observe(dataclasses.replace(sensor, known=landmark), point)

    def invert(
        self, sensor: Sensor, z: Array, tag: Array, point: LinearizationPoint
    ) -> tuple[Array, Array, Array]:
        return self.linearize.invert(sensor, z, tag, point)


@record
class _OfRobot(Wrapped):
    """A sensor of a known landmark, as a sensor of the robot alone."""

    sensor: Sensor
    known: PyTree = None
    """(L,) the landmark; None of an absolute sensor"""
    landmark = ()
    free = NOTHING_FREE

    def observe(self, pose: Array, landmark: Array) -> Array:
        return self.sensor.observe(pose, landmark if self.known is None else self.known)

    def invert(self, pose: Array, z: Array, s: Array) -> Array:
        return jnp.zeros(0, pose.dtype)

    def position(self, landmark: Array) -> Array:
        return jnp.zeros(2, landmark.dtype)

    def embed(self, pose: Array, point: Array) -> Array:
        return jnp.zeros(0, pose.dtype)


@record
class _OfPose(Chart):
    """A chart restricted to the pose, for landmarks without parameters."""

    chart: Chart

    def retract(self, pose: Array, landmark: Array, dx: Array, dl: Array) -> tuple[Array, Array]:
        at = self._ground(landmark)
        return self.chart.retract(pose, at, dx, at)[0], landmark

    def local(
        self, pose0: Array, landmark0: Array, pose: Array, landmark: Array
    ) -> tuple[Array, Array]:
        at = self._ground(landmark)
        return self.chart.local(pose0, at, pose, at)[0], jnp.zeros(0, landmark.dtype)

    @property
    def basis(self) -> Callable[[Array, Array], Basis] | None:
        return None if self.chart.basis is None else self._basis

    def _basis(self, pose: Array, landmark: Array) -> Basis:
        by_pose = self.chart.basis(pose, self._ground(landmark)).pose
        return Basis(by_pose, jnp.zeros((0, 3), pose.dtype), None)

    def _ground(self, landmark: Array) -> Array:
        size = 2 if self.chart.landmark_size is None else self.chart.landmark_size
        return jnp.zeros(size, landmark.dtype)


@record
class _NeverNew:
    """An association method that starts no landmark."""

    associate: Associate

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        found = Association(*self.associate(prediction, scan))
        return found._replace(is_new=jnp.zeros_like(found.is_new))


def hold_map(filter: Any) -> None:
    """Check and hold the fields landmarks (N, L) and tags of a filter, in `__post_init__`.

    Raises ValueError, which begins with its class, on invalid ones.
    """
    name, landmarks, tags = type(filter).__name__, held_array(filter.landmarks), filter.tags
    set_field(filter, "landmarks", landmarks)
    size, shape = len(filter.sensor.landmark), np.shape(landmarks)
    if len(shape) != 2 or shape[1] != size or shape[0] == 0:
        raise ValueError(f"{name}: expected landmarks of shape (at least 1, {size}), got {shape}")
    if not np.issubdtype(jnp.result_type(landmarks), np.number) or jnp.iscomplexobj(landmarks):
        raise ValueError(f"{name}: expected a map of real numbers")
    if is_concrete(landmarks) and not np.isfinite(np.asarray(landmarks)).all():
        raise ValueError(f"{name}: the map is not finite")
    if tags is None:
        return
    most, values = np.iinfo(np.int32).max, np.asarray(tags)
    good = values.shape == shape[:1] and np.issubdtype(values.dtype, np.integer)
    if not good or len(np.unique(values)) != shape[0] or values.min() < 0 or values.max() > most:
        raise ValueError(
            f"{name}: expected {shape[0]} different tags from 0 to {most}, got {tags!r}"
        )
    set_field(filter, "tags", tuple(values.tolist()))


def map_tags(filter: Any) -> Int[Array, "N"]:
    """The tags (N,) int32 of the known map of a filter."""
    count = np.shape(filter.landmarks)[0]
    return jnp.asarray(range(count) if filter.tags is None else filter.tags, jnp.int32)
