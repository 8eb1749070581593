"""EKF localization: the robot's pose in a known map."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam import slots, validation
from jaxslam.association.known import known as known_association
from jaxslam.charts.euclidean import euclidean
from jaxslam.core.numbers import is_concrete
from jaxslam.core.record import record
from jaxslam.filters.ekf.settings import (
    Covariance,
    EkfSettings,
    Update,
    check_covariance_form,
    check_ekf_options,
    check_iterations,
)
from jaxslam.filters.ekf.steps.predict import propagate
from jaxslam.filters.ekf.steps.scan import SensorTurn, update_by_scan
from jaxslam.linearize.at_estimate import at_estimate
from jaxslam.math import linalg
from jaxslam.protocols import (
    NOTHING_FREE,
    Associate,
    Association,
    Basis,
    Chart,
    Filter,
    Here,
    Linearizer,
    Motion,
    Prediction,
    Sensor,
)
from jaxslam.sensors.suite import Suite
from jaxslam.sensors.wrapped import Wrapped
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, Scan

Array = jax.Array


def localization(
    motion: Motion,
    sensor: Sensor,
    landmarks: ArrayLike,
    *,
    tags: ArrayLike | None = None,
    chart: Chart | None = None,
    linearize: Linearizer | None = None,
    associate: Associate | None = None,
    update: Update = "sequential",
    gate: float | None = None,
    iterations: int = 1,
    covariance: Covariance = "plain",
) -> Filter:
    """Extended Kalman filter of the pose in a known map without errors (Williams, localization).

    The equations of EKF-SLAM with P_ll = 0: z = h(x, l_j) with H by the pose only, P (3, 3). A step
    costs O(M), plus the search for tags among N (0.09 ms a step with 10,000); association other
    than by tags compares all landmarks. With a `sensors.Suite`, absolute sensors (compass, position
    fix) correct in the same update.

    The state is a `slots.Joint` whose landmarks have no parameters. A measurement without a
    landmark in the map is `Status.UNMATCHED`.

    Args:
        motion, sensor: as for `ekf_slam`.
        landmarks: (N, L) the map, in the sensor's parameters.
        tags: (N,) int, different; default the row numbers.
        chart: the error coordinates of P; its pose part. Default `charts.euclidean()`.
        linearize: one without a memory of landmarks (at_estimate, unscented).
        associate, update, gate, iterations: as for `ekf_slam`.
        covariance: "plain" or "joseph", as there.
    Raises:
        ValueError: on a map that is not finite (N, L), tags that are not N different numbers from 0
            on, a chart or linearizer that needs the landmarks' errors, and as `ekf_slam` does.
    """
    validation.check_models("localization", motion, sensor)
    validation.check_parts("localization", chart=chart, linearize=linearize, associate=associate)
    points, names = checked_map("localization", sensor, landmarks, tags)
    capacity = points.shape[0]
    chart = _of_pose(chart or euclidean())
    linearize = linearize or at_estimate()
    check_ekf_options("localization", capacity, update, gate, iterations, None)
    check_covariance_form("localization", covariance, ("plain", "joseph"))
    if linearize.own_landmarks:
        raise ValueError(
            f"localization: the linearizer {linearize.name} is for estimated maps, not for a known "
            "one"
        )
    check_iterations("localization", linearize, iterations)
    settings = EkfSettings(
        sensor=sensor,
        chart=chart,
        linearize=linearize,
        associate=_never_new(associate or known_association()),
        update=update,
        gate=gate,
        iterations=iterations,
        covariance=covariance,
        births=0,
    )
    places = sensor.places if isinstance(sensor, Suite) else ()
    turns = [SensorTurn(None, _in_map(sensor, points, settings))]
    if isinstance(sensor, Suite):
        turns = [
            SensorTurn(
                part.places,
                None if part.sees == "robots" else _in_map(part.sensor, points, settings),
            )
            for part in sensor.parts
        ]

    def init(pose: Array, pose_cov: Array) -> Joint:
        ground = jnp.zeros((capacity, 0), pose.dtype)
        if chart.basis is not None:
            undo = linalg.inverse(chart.basis(pose, ground[0]).pose)
            pose_cov = undo @ pose_cov @ undo.T
        joint = slots.empty(pose, pose_cov, capacity, 0, linearize.init(pose, ground))
        return joint._replace(alive=jnp.ones(capacity, bool), tag=jnp.asarray(names))

    def predict(joint: Joint, u: Array, key: Array) -> Joint:
        return propagate(joint, u, motion, settings)[0]

    def update_pose(joint: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return update_by_scan(joint, scan, turns)[:2]

    def estimate(joint: Joint) -> Estimate:
        cov = joint.cov
        if chart.basis is not None:
            basis = chart.basis(joint.pose, joint.landmarks[0]).pose
            cov = basis @ cov @ basis.T
        where = jax.vmap(sensor.position)(jnp.asarray(points, joint.pose.dtype))
        return Estimate(
            pose=joint.pose,
            pose_cov=cov,
            points=where,
            point_covs=jnp.zeros((capacity, 2, 2), cov.dtype),
            alive=joint.alive,
            tag=joint.tag,
        )

    return Filter(
        name="localization",
        controls=motion.controls,
        measurements=sensor.measurements,
        init=init,
        predict=predict,
        update=update_pose,
        estimate=estimate,
        chart=chart,
        places=places,
    )


def _in_map(sensor: Sensor, points: PyTree, settings: EkfSettings) -> EkfSettings:
    """The settings for one sensor of known landmarks, or for an absolute sensor."""
    absolute = not sensor.landmark
    linearize = settings.linearize if absolute else _on_map(settings.linearize, points)
    return dataclasses.replace(
        settings, sensor=_OfRobot(sensor), linearize=linearize, absolute=absolute
    )


def _on_map(linearize: Linearizer, points: PyTree) -> Linearizer:
    """The linearizer with the landmark of a slot as a constant of the sensor."""

    def observe(sensor: Sensor, here: Here) -> tuple[Array, Array, Array, Array]:
        landmark = jnp.asarray(points, here.pose.dtype)[here.slot]
        return linearize.observe(dataclasses.replace(sensor, known=landmark), here)

    return dataclasses.replace(linearize, observe=observe)


@record
class _OfRobot(Wrapped):
    """A sensor as one of the robot alone: the landmark that it measures is known."""

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


def _of_pose(chart: Chart) -> Chart:
    """The chart restricted to the pose, for landmarks without parameters."""
    whole_basis = chart.basis
    size = 2 if chart.landmark_size is None else chart.landmark_size

    def ground(landmark: Array) -> Array:
        return jnp.zeros(size, landmark.dtype)

    def retract(pose: Array, landmark: Array, dx: Array, dl: Array) -> tuple[Array, Array]:
        at = ground(landmark)
        return chart.retract(pose, at, dx, at)[0], landmark

    def local(pose0: Array, landmark0: Array, pose: Array, landmark: Array) -> tuple[Array, Array]:
        at = ground(landmark)
        return chart.local(pose0, at, pose, at)[0], jnp.zeros(0, landmark.dtype)

    def basis(pose: Array, landmark: Array) -> Basis:
        assert whole_basis is not None
        by_pose = whole_basis(pose, ground(landmark)).pose
        return Basis(by_pose, jnp.zeros((0, 3), pose.dtype), None)

    return Chart(chart.name, retract, local, None if whole_basis is None else basis)


def _never_new(associate: Associate) -> Associate:
    def within(prediction: Prediction, scan: Scan) -> Association:
        found = Association(*associate(prediction, scan))
        return found._replace(is_new=jnp.zeros_like(found.is_new))

    return within


def checked_map(
    name: str, sensor: Sensor, landmarks: ArrayLike, tags: ArrayLike | None
) -> tuple[PyTree, np.ndarray]:
    """The landmarks and their tags (N,) int32, or a ValueError that begins with a filter's name."""
    size = len(sensor.landmark)
    if np.ndim(landmarks) != 2 or np.shape(landmarks)[1] != size or np.shape(landmarks)[0] == 0:
        raise ValueError(
            f"{name}: expected landmarks of shape (at least 1, {size}), got {np.shape(landmarks)}"
        )
    if not np.issubdtype(jnp.result_type(landmarks), np.number) or jnp.iscomplexobj(landmarks):
        raise ValueError(f"{name}: expected a map of real numbers")
    if is_concrete(landmarks) and not np.isfinite(np.asarray(landmarks)).all():
        raise ValueError(f"{name}: the map is not finite")
    count = np.shape(landmarks)[0]
    names: np.ndarray = np.arange(count) if tags is None else np.asarray(tags)
    good = names.shape == (count,) and np.issubdtype(names.dtype, np.integer)
    most = np.iinfo(np.int32).max
    if not good or len(set(names.tolist())) != count or not 0 <= names.min() <= names.max() <= most:
        raise ValueError(f"{name}: expected {count} different tags from 0 to {most}, got {tags!r}")
    points = landmarks if hasattr(landmarks, "shape") else np.asarray(landmarks)
    return points, names.astype(np.int32)
