"""Worlds of runs that were recorded, or simulated by other means, for campaigns."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from jaxslam._public import publish
from jaxslam.core._numbers import check_array
from jaxslam.core._record import FrozenDict, record, static
from jaxslam.core._units import are_headings_in_degrees
from jaxslam.core._validation import check_log, check_record
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Log, Truth
from jaxslam.sensors._suite import Suite
from jaxslam.simulation._worlds import World


@record
class RecordedWorld(World):
    """A world of R runs that were recorded: run i of a campaign is record i (`recorded_world`)."""

    name: str = static()
    motion: Motion = field()
    sensor: Sensor = field()
    truth: Truth = field()
    """(R, …)"""
    log: Log = field()
    """(R, …)"""
    pose: ArrayLike = (0.0, 0.0, 0.0)
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    filter_options: dict[str, Any] = static(default=FrozenDict())
    published: Mapping[str, Mapping[str, float]] = static(default=FrozenDict())
    source: str = static(default="")
    """see `Scenario` for these fields"""

    @property
    def landmarks(self) -> ArrayLike:  # type: ignore[override]
        return self.truth.landmarks[0]

    @property
    def controls(self) -> ArrayLike:  # type: ignore[override]
        return self.log.control[0]

    @property
    def recorded_runs(self) -> int:  # type: ignore[override]
        return len(self.truth.pose)

    def draw(self, key: Array) -> tuple[Truth, Log]:
        return self._record(jax.random.randint(key, (), 0, self.recorded_runs))

    def run(self, key: Array, number: int | Array) -> tuple[Truth, Log]:
        return self._record(number)

    def _record(self, number: int | Array) -> tuple[Truth, Log]:
        record: tuple[Truth, Log] = jax.tree.map(
            lambda leaf: jnp.asarray(leaf)[number], (self.truth, self.log)
        )
        return record


def recorded_world(
    motion: Motion,
    sensor: Sensor,
    logs: Sequence[Log],
    poses: Sequence[ArrayLike],
    landmarks: ArrayLike,
    *,
    name: str = "recorded",
    pose: ArrayLike = (0.0, 0.0, 0.0),
    pose_cov: ArrayLike = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    starts: ArrayLike | None = None,
    origin: ArrayLike | None = None,
    filter_options: dict[str, Any] | None = None,
    published: Mapping[str, Mapping[str, float]] | None = None,
    source: str = "",
) -> RecordedWorld:
    """A world of R runs with known truth, in which run i of a campaign is record i.

    So logs of another simulator, of robots under motion capture, or of a front end that is not a
    pure function (laser odometry) are judged as draws are. `simulate` takes one of the records by
    its key. A campaign of more than R runs is refused.

    Args:
        motion, sensor: the models that filters and the bound assume of the logs.
        logs: (R,) each with T rows and M measurement slots; in a row without measurements none is
            valid.
        poses: (R, T, 3) true pose at each row [m, m, rad].
        landmarks: (N, L) true landmarks, of all runs, or (R, N, L); the tag of one is its row.
        pose, pose_cov: (3,) and (3, 3), the filter's prior of the pose before the first control,
            of every run: transform records that begin elsewhere.
        starts: (R, 3) true pose before the first control; default `pose`.
        origin: (R, T, M) tag of the landmark that each measurement is truly of, -1 of none, where
            associations are to be scored.
        filter_options, published, source: as of `Scenario`.
    Raises:
        ValueError: on no runs, a log that `run` would refuse (which), runs of different shapes, a
            tag without a landmark, a truth that is not finite, and as `Scenario` does.
    Warns:
        UserWarning: on true headings that fit their path in degrees.
    """
    check_record("recorded_world", "motion", motion, Motion)
    check_record("recorded_world", "sensor", sensor, Sensor)
    if isinstance(logs, Log) or not isinstance(logs, Sequence) or not logs:
        empty = "an empty " * (isinstance(logs, Sequence) and not logs)
        raise ValueError(
            "recorded_world: expected logs as a list of Log, one a run, got "
            f"{empty}{type(logs).__name__}"
        )
    table = np.asarray(landmarks, np.float64)
    if table.ndim == 2:
        table = np.broadcast_to(table, (len(logs), *table.shape))
    for i, log in enumerate(logs):
        check_record("recorded_world", f"logs[{i}]", log, Log)
        check_log(
            f"recorded_world: run {i}",
            log,
            control_size=len(motion.controls),
            measurement_size=len(sensor.measurements),
            parts=sensor.places if isinstance(sensor, Suite) else (),
        )
        if np.shape(log.scan.tag) != np.shape(logs[0].scan.tag):
            raise ValueError(
                "recorded_world: expected logs of the same numbers of rows and measurement slots, "
                f"got {np.shape(logs[0].scan.tag)} in run 0 and {np.shape(log.scan.tag)} in run {i}"
            )
    log = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *logs)
    runs, steps, places = log.scan.tag.shape
    first = np.broadcast_to(np.asarray(pose, np.float64), (runs, 3)) if starts is None else starts
    truth = Truth(
        np.asarray(poses, np.float64),
        table,
        np.zeros((runs, steps), np.int32),
        np.asarray(first, np.float64),
        None if origin is None else np.asarray(origin),
    )
    check_array("recorded_world: poses", truth.pose, (runs, steps, 3))
    check_array("recorded_world: landmarks", table, (runs, "N", len(sensor.landmark)))
    check_array("recorded_world: starts", truth.start, (runs, 3))
    if truth.origin is not None:
        check_array("recorded_world: origin", truth.origin, (runs, steps, places), np.integer)
    for name_of_field in ("pose", "landmarks", "start"):
        finite = np.isfinite(getattr(truth, name_of_field))
        if not finite.all():
            run, *place = np.argwhere(~finite)[0]
            row, hint = "", ""
            if name_of_field == "pose":
                row = f", row {place[0]}"
                hint = ": cut the log to rows with a true pose"
            raise ValueError(
                f"recorded_world: true {name_of_field} of run {run}{row}: expected finite numbers"
                f"{hint}"
            )
    if wrong := [i for i, path in enumerate(truth.pose) if are_headings_in_degrees(path)]:
        warnings.warn(
            f"recorded_world: the true headings of run {wrong[0]} contradict the directions "
            "between its positions, which fit them as degrees: expected [rad]",
            stacklevel=2,
        )
    tags = np.where(log.scan.valid, log.scan.tag, -1)
    if tags.max(initial=-1) >= table.shape[1]:
        run, row, _ = np.argwhere(tags >= table.shape[1])[0]
        raise ValueError(
            f"recorded_world: expected tags below {table.shape[1]}, the number of landmarks, got "
            f"{tags.max()} (run {run}, row {row})"
        )
    return RecordedWorld(
        name=name,
        motion=motion,
        sensor=sensor,
        truth=truth,
        log=log,
        pose=pose,
        pose_cov=pose_cov,
        filter_options=filter_options or {},
        published=published or {},
        source=source,
    )


publish("jaxslam", RecordedWorld, recorded_world)
